"""Bounds of the gains that a rig accepts: as live ones, and for one trial."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Self

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput

EXCESS_LIVE, EXCESS_TRIAL = 1e2, 1e4
"""How many times over the greatest effort a gain may take one step of the suggested size. A trial
is short and guarded; model-based searches look at gains up to 1e4 times their start."""

Range = tuple[float, float | None]


@dataclass(frozen=True, slots=True)
class GainBounds:
    """Least and greatest value of each gain; without a greatest value None.

    Attributes:
        P: Of P.
        I: Of I.
        D: Of D.
        setpoint_filter_s: Of the setpoint filter's time constant, s.

    Raises:
        InvalidInput: a bound is not finite or below zero, or two are the wrong way round.
    """

    P: Range = (0.0, None)
    I: Range = (0.0, None)
    D: Range = (0.0, None)
    setpoint_filter_s: Range = (0.0, None)

    def __post_init__(self) -> None:
        for name, (low, high) in self.items():
            if not 0.0 <= low < math.inf or not low <= high:
                raise InvalidInput(
                    f"bounds of gain {name} are {low:g} to {high:g}; give numbers from zero up, "
                    "in order"
                )

    def items(self) -> Iterator[tuple[str, tuple[float, float]]]:
        """Name, least and greatest value of each gain; infinite where there is no greatest."""
        for field in fields(self):
            low, high = getattr(self, field.name)
            yield field.name, (low, math.inf if high is None else high)

    def check(self, gains: Gains, what: str) -> None:
        """Refuses gains outside the bounds.

        Args:
            gains: The gains.
            what: What they are to be: `live`, or `a trial's`.

        Raises:
            InvalidInput: one of them is outside; the message names it.
        """
        for name, (low, high) in self.items():
            value = getattr(gains, name)
            if not low <= value <= high:
                raise InvalidInput(
                    f"gain {name} {value:.6g} is outside the rig's bounds of {what} gains, "
                    f"{low:g} to {high:g}; choose others, or widen [gain_bounds] in the rig's file"
                )

    def and_default(self, default: Self) -> Self:
        """These bounds, those that are left open by the default."""
        cls = type(self)
        mine = {name: getattr(self, name) for name in GAIN_NAMES}
        return cls(**{n: b if b != (0.0, None) else getattr(default, n) for n, b in mine.items()})

    def __str__(self) -> str:
        return ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in self.items())


UNBOUNDED = GainBounds()


def bounds_by_effort(
    controller: ControllerSettings,
    step: float,
    settling_time_s: float,
    duration_max_s: float,
    excess: float,
) -> GainBounds:
    """Bounds up to which one step takes the effort at most so many times over its limit.

    P by the step itself, I by its integral over the settling time, D by a measurement that
    follows it at once; a setpoint filter lasts as long as the longest trial at most. Without a
    limit of the effort there are none.
    """
    effort = max(abs(controller.output_min_N), abs(controller.output_max_N))
    per_step = _rounded(excess * effort / abs(step))
    if per_step is None:
        return UNBOUNDED
    lag_s = controller.derivative_filter_s + 1.0 / controller.sampling_Hz
    return GainBounds(
        (0.0, per_step),
        (0.0, _rounded(per_step / settling_time_s)),
        (0.0, _rounded(per_step * lag_s)),
        (0.0, _rounded(duration_max_s)),
    )


def _rounded(value: float) -> float | None:
    """To six digits, as messages show it; None for one without end."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
