"""The four tuned numbers of the PIDF controller."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from estune.core.quantities import check_not_negative, check_positive
from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class Gains:
    """The gains of the parallel form, `u = P e + I int(e) - D dy/dt`, and the setpoint filter.

    Attributes:
        P: Proportional gain, output unit per input unit (N/N on a reel); above zero.
        I: Integral gain, 1/s times the unit of P; zero or above.
        D: Derivative gain, s times the unit of P; zero or above.
        setpoint_filter_s: Time constant of the first-order setpoint filter F, s; zero is none.

    Raises:
        InvalidInput: a value is not finite, or below its least value.
    """

    P: float
    I: float
    D: float
    setpoint_filter_s: float

    def __post_init__(self) -> None:
        check_positive("gain P", self.P)
        for name in ("I", "D", "setpoint_filter_s"):
            check_not_negative(f"gain {name}", getattr(self, name))

    @classmethod
    def from_standard(cls, K: float, Ti: float, Td: float, setpoint_filter_s: float = 0.0) -> Self:
        """Gains of the standard form, `K (1 + 1/(Ti s) + Td s)`: P = K, I = K/Ti, D = K Td.

        Args:
            K: Proportional gain.
            Ti: Integral time, s; infinity is no integral action.
            Td: Derivative time, s.
            setpoint_filter_s: Time constant of the setpoint filter, s.

        Raises:
            InvalidInput: Ti is not above zero, or a gain is out of its range.
        """
        if not Ti > 0.0:
            raise InvalidInput(f"integral time Ti is {Ti} s; it must be above zero")
        return cls(K, K / Ti, K * Td, setpoint_filter_s)

    def to_standard(self) -> tuple[float, float, float]:
        """(K, Ti, Td) of the standard form, times in s; Ti is infinite without integral action."""
        return self.P, self.P / self.I if self.I > 0.0 else math.inf, self.D / self.P

    def as_tuple(self) -> tuple[float, float, float, float]:
        """(P, I, D, setpoint_filter_s)."""
        return self.P, self.I, self.D, self.setpoint_filter_s

    def text(self, units: Mapping[str, str]) -> str:
        """The gains with their units, which follow from those of the plant; see `gain_units`."""
        labels = {"setpoint_filter_s": "setpoint filter"}
        return ", ".join(
            f"{labels.get(name, name)} {getattr(self, name):.4g} {units[name]}".rstrip()
            for name in GAIN_NAMES
        )

    def __str__(self) -> str:
        return self.text({"P": "", "I": "", "D": "", "setpoint_filter_s": "s"})


GAIN_NAMES = ("P", "I", "D", "setpoint_filter_s")


def gain_units(measurement: str, command: str) -> dict[str, str]:
    """Units of the gains of a plant, from those of what it measures and is commanded."""
    if measurement == command:
        ratio = f"{command}/{measurement}" if command else ""
        return {"P": ratio, "I": "1/s", "D": "s", "setpoint_filter_s": "s"}
    if not measurement:
        return {"P": command, "I": f"{command}/s", "D": f"{command} s", "setpoint_filter_s": "s"}
    top, compound = command or "1", bool({"/", " "} & set(measurement))
    below = f"({measurement})" if compound else measurement
    return {
        "P": f"{top}/{below}",
        "I": f"{top}/{below}/s" if compound else f"{top}/({measurement} s)",
        "D": f"{top} s/{below}",
        "setpoint_filter_s": "s",
    }


GAIN_UNITS = gain_units("N", "N")
"""Units of the gains of a reel."""
