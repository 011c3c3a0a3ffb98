"""The four tuned numbers of the PIDF controller."""

import math
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

    def __str__(self) -> str:
        return (
            f"P {self.P:.4g} N/N, I {self.I:.4g} 1/s, D {self.D:.4g} s, "
            f"setpoint filter {self.setpoint_filter_s:.4g} s"
        )


GAIN_NAMES = ("P", "I", "D", "setpoint_filter_s")
GAIN_UNITS = {"P": "N/N", "I": "1/s", "D": "s", "setpoint_filter_s": "s"}
