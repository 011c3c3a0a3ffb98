"""A fitted value and its confidence interval."""

from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Interval:
    """A fitted value and its 95 % confidence interval.

    Attributes:
        low: Lower end, inside the parameter's range.
        unit: Unit of all three; empty for a plain number.
    """

    value: float
    low: float
    high: float
    unit: str

    @property
    def is_determined(self) -> bool:
        """Whether the interval is no wider than the value is large."""
        return self.high - self.low <= abs(self.value)

    def over(self, size: float) -> "Interval":
        """The same as a multiple of a size above zero."""
        return replace(self, value=self.value / size, low=self.low / size, high=self.high / size)
