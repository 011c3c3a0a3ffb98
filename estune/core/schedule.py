"""Gain schedule: each gain as a curve of cable length and tension, within a range of validity.

The paper's adaptive law is one such curve, I = a + b L (Fig. 14); the other forms compete with it
in a regression. The curves use arithmetic and numpy's `log` only, so that they serve floats on the
rig, arrays in a figure, and CasADi symbols.
"""

import math
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Literal, Self, get_args

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput

Signal = Any
"""A float, an array, or a CasADi expression."""

Form = Literal["constant", "linear", "log", "inverse"]
FORMS: tuple[Form, ...] = get_args(Form)


def length_term(form: Form, length_m: Signal) -> Signal:
    """The term of a form's slope: L, ln L or 1/L; zero for a constant."""
    match form:
        case "constant":
            return 0.0 * length_m
        case "linear":
            return length_m
        case "log":
            return np.log(length_m)
        case "inverse":
            return 1.0 / length_m


FORMAT = 1
"""Version of stored schedules, as their key `format`; one without it has the first."""


@dataclass(frozen=True, slots=True)
class GainCurve:
    """One gain, g = a + b f(L) + c T, with f(L) one of L, ln L and 1/L.

    Attributes:
        form: Which f.
        offset: a, in the gain's unit.
        slope: b, in the gain's unit per unit of f; zero for a constant.
        per_newton: c, in the gain's unit per N; zero without influence of the tension.

    Raises:
        InvalidInput: there is no such form, a number is not finite, or a constant has a slope.
    """

    form: Form
    offset: float
    slope: float = 0.0
    per_newton: float = 0.0

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise InvalidInput(
                f"a gain cannot be {self.form!r} in length; the forms are {', '.join(FORMS)}"
            )
        numbers = (self.offset, self.slope, self.per_newton)
        if not all(map(math.isfinite, numbers)):
            raise InvalidInput(f"gain curve {numbers} holds a value that is not finite")
        if self.form == "constant" and self.slope != 0.0:
            raise InvalidInput(f"a constant gain has slope {self.slope}; it must be 0")

    def at(self, length_m: Signal, tension_N: Signal) -> Signal:
        """The gain at a length in m and a tension in N, without limits."""
        along = self.slope * length_term(self.form, length_m)
        return self.offset + along + self.per_newton * tension_N

    def __str__(self) -> str:
        along = {"constant": "", "linear": "L", "log": "ln L", "inverse": "/L"}[self.form]
        terms = [f"{self.offset:.4g}"]
        if along:
            terms.append(f"{self.slope:+.4g} {along}".replace(" /", "/"))
        if self.per_newton:
            terms.append(f"{self.per_newton:+.4g} T")
        return " ".join(terms)


@dataclass(frozen=True, slots=True)
class GainSchedule:
    """Gains over cable length and tension; beyond its range, those at the nearest end.

    Attributes:
        P: Proportional gain, N/N.
        I: Integral gain, 1/s.
        D: Derivative gain, s.
        setpoint_filter_s: Time constant of the setpoint filter, s.
        length_m: Least and greatest valid cable length, m.
        tension_N: Least and greatest valid tension, N; equal if only one was tuned.

    Raises:
        InvalidInput: the range is not finite, not above zero or not in order, or a gain is
            invalid somewhere in it.
    """

    P: GainCurve
    I: GainCurve
    D: GainCurve
    setpoint_filter_s: GainCurve
    length_m: tuple[float, float]
    tension_N: tuple[float, float]

    def __post_init__(self) -> None:
        for what, (low, high), unit in (
            ("cable length", self.length_m, "m"),
            ("tension", self.tension_N, "N"),
        ):
            if not (math.isfinite(low) and math.isfinite(high) and 0.0 < low <= high):
                raise InvalidInput(
                    f"the schedule's {what} is {low} to {high} {unit}; it must be above zero, "
                    "finite and in order"
                )
        # Every form is monotone in length and linear in tension: the extremes are at the corners.
        for length, tension in product(self.length_m, self.tension_N):
            try:
                self.gains(length, tension)
            except InvalidInput as error:
                raise InvalidInput(
                    f"the schedule cannot be used at {length:g} m and {tension:g} N: {error}; "
                    "narrow its range, or choose another form"
                ) from error

    @property
    def extremes(self) -> tuple[Gains, ...]:
        """The gains at the corners of the range, between which each gain lies everywhere."""
        corners = product(self.length_m, self.tension_N)
        return tuple(self.gains(length, tension) for length, tension in corners)

    @property
    def curves(self) -> tuple[GainCurve, GainCurve, GainCurve, GainCurve]:
        """The curves in the order of `GAIN_NAMES`."""
        return self.P, self.I, self.D, self.setpoint_filter_s

    def gains(self, length_m: float, tension_N: float) -> Gains:
        """The gains at a cable length in m and a tension in N, both clipped to the range.

        NaN counts as the least value, so that a failed reading leaves valid gains.
        """
        length, tension = _clipped(length_m, self.length_m), _clipped(tension_N, self.tension_N)
        return Gains(*[float(curve.at(length, tension)) for curve in self.curves])

    def as_dict(self) -> dict[str, Any]:
        """The schedule as JSON values; floats survive exactly."""
        return {
            "format": FORMAT,
            "length_m": list(self.length_m),
            "tension_N": list(self.tension_N),
            "gains": {
                name: asdict(curve) for name, curve in zip(GAIN_NAMES, self.curves, strict=True)
            },
        }

    @classmethod
    def from_dict(cls, stored: Any) -> Self:
        """The schedule of the values that `as_dict` gave.

        Raises:
            InvalidInput: a value is missing or has the wrong type, the format is unknown, or as
                for the class.
        """
        if isinstance(stored, dict) and stored.get("format", FORMAT) != FORMAT:
            raise InvalidInput(
                f"stored gain schedule of format {stored['format']!r}; this estune reads format "
                f"{FORMAT}: use the estune that wrote it, or a newer one"
            )
        try:
            curves = {name: GainCurve(**stored["gains"][name]) for name in GAIN_NAMES}
            low, high = map(float, stored["length_m"])
            least, most = map(float, stored["tension_N"])
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, InvalidInput):
                raise
            raise InvalidInput(
                f"stored gain schedule is damaged: {error!r}; write it again"
            ) from error
        return cls(**curves, length_m=(low, high), tension_N=(least, most))


def _clipped(value: float, ends: tuple[float, float]) -> float:
    low, high = ends
    return min(value, high) if value > low else low
