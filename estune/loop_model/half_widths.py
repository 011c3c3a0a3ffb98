"""How far inside its limits a search aims: as far as the intervals reach at its optimum."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from estune.core.gains import Gains
from estune.loop_model.intervals import margins_by_records
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.near_fit import is_explained, near_error
from estune.loop_model.peak import peak_deviation
from estune.loop_model.plant_error import band_powers, error_margin
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord

ASSUMED, LARGEST = 0.03, 0.05
"""Logarithm of the upper end of the interval of Ms over Ms before it is known, and the most that a
search keeps from its limit where it is wider."""

OVERSHOOT, OF_NOISE = 0.003, 2.0
"""Half width of the overshoot, as a share of the step and of the noise, where it is measured and
not predicted. The peak of a record is 0.4 times its noise too high on average and scatters by 0.7
times (15 random loops, noise of 0.2 to 2 % of the step), so that of two records the upper end of
the interval lies 1.4 times higher on average, and 2 times higher in one of ten."""

REPEATS, MOVES = 2, 1.5
"""Trials of a confirmation at least, and the half width of the overshoot then over that before,
with what its estimate moves by: with 1 the upper end lay 0.01 to 0.14 % of the step above the
limit on 3 of 14 plants of `experiments.batch` whose overshoot is limited, with 1.25 on 2."""

OVERSHOOT_MOST = 0.015
"""Most half width of the overshoot, as a share of the step, where no model explains all trials or
their gain is not the same: where it varies by 2 to 15 % it is 1.2 to 2.5 %."""

SHOWN = 3.2
"""Upper end of what the trials show of a peak, in standard deviations, in nine of ten cases: 1.96,
and what their mean lies too high."""

NEAR_APART = 0.02
"""Logarithm of Ms by the trials near some gains over that by all, which a search aims with, where
no model explains all: up to 2.2 % on ten of `experiments.loop_claims.mild`, 1.1 % in the root mean
square."""

PHASE_MARGIN_deg = 2.0
"""Half width of the phase margin before it is known: they are 1 to 2 degrees."""


class HalfWidths(NamedTuple):
    """Distances of 95 % intervals' ends from their estimates, towards the limits.

    Attributes:
        sensitivity: Logarithm of the upper end of Ms over Ms.
        overshoot: As a share of the step.
        phase_margin_deg: Degrees.
    """

    sensitivity: float
    overshoot: float
    phase_margin_deg: float

    @property
    def is_wide(self) -> bool:
        """Whether the search aims outside of what the interval of Ms asks for."""
        return self.sensitivity >= LARGEST

    @classmethod
    def none(cls) -> "HalfWidths":
        """Those of a loop that is known."""
        return cls(0.0, 0.0, 0.0)

    @classmethod
    def assumed(cls, noise: float) -> "HalfWidths":
        """Those before any is known, with noise of a standard deviation in shares of the step."""
        return cls(ASSUMED, OVERSHOOT + OF_NOISE * noise, PHASE_MARGIN_deg)


def half_widths(
    fit: LoopFit,
    records: Sequence[LoopRecord],
    trial: StepTrial,
    gains: Gains,
    repeats: int = REPEATS,
) -> HalfWidths:
    """Those that a claim of some gains will have after their confirmation.

    What the noise hides of the plant's error falls by the trials to come; the estimate of Ms moves
    by up to its interval of the model meanwhile. The overshoot is predicted where the model
    explains the records, else it will be measured. Where an end is not known, the half width is
    the assumed one.

    Args:
        records: The records given to the fit, a step trial first.
        repeats: Trials of these gains to come.
    """
    at = margins_by_records(fit, records, trial, gains)
    assumed = HalfWidths.assumed(fit.noise_std / abs(trial.step.size))
    _, effort = setpoint_response(fit.model, records[0], gains, trial.controller)
    bound = band_powers(fit, records).bound(effort, repeats)
    error = error_margin(fit, bound, gains, trial.controller)
    Ms, overshoot, angle = at.sensitivity, at.overshoot, at.phase_margin_deg
    above = math.hypot(*(math.log(end / Ms.value) for end in (Ms.high, error.sensitivity)))
    over, most = math.inf, assumed.overshoot
    if not is_explained(fit):
        above = math.hypot(above, near_error(fit.misfit), NEAR_APART)
        over, most = max(overshoot.high - overshoot.value, most), max(most, OVERSHOOT_MOST)
    elif fit.is_white:
        most = max(most, OVERSHOOT_MOST) if fit.strengths else most
        shown = SHOWN * peak_deviation(fit, trial, gains) / math.sqrt(REPEATS)
        over = math.hypot(MOVES * (overshoot.high - overshoot.value), shown)
    below = angle.value - angle.low
    return HalfWidths(
        min(above, LARGEST) if math.isfinite(above) else assumed.sensitivity,
        min(over, most) if math.isfinite(over) else assumed.overshoot,
        below if math.isfinite(below) else assumed.phase_margin_deg,
    )
