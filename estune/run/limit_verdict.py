"""Whether the gains of a run keep the limits of the run, whichever tuner found them."""

import math
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.claim import Claim
from estune.loop_model.intervals import Interval
from estune.loop_model.optimum import RobustnessLimits
from estune.run.ending import RunEnding
from estune.run.plan import Plan
from estune.trial import Outcome, TrialRecord
from estune.trial.scoring import metrics_of

SENSITIVITY_ALLOWED = 0.05
"""Share by which the interval of Ms may reach beyond its limit. Searches end at the limit, so that
half of the interval lies beyond it, and it is never narrower than 2 % to each side (the error of
the model), with an excitation 2 to 4 %."""

OVERSHOOT_ALLOWED = 0.01
"""The same of the overshoot, as a share of the step: on the emulated reel that of repeats scatters
by 0.4 %."""

PHASE_MARGIN_ALLOWED_deg = 2.0
"""The same of the phase margin, whose intervals are 1 to 2 degrees wide where Ms is claimed."""


FEWEST_REPEATS = 4
"""Repeats from which their own scatter gives the interval: of two its quantile is 12.7."""


class LimitState(StrEnum):
    """Whether limits are kept."""

    KEPT = "kept"
    NOT_SHOWN = "not shown"
    BROKEN = "broken"


class LimitVerdict(NamedTuple):
    """Whether some gains keep the limits of a run.

    Attributes:
        state: Kept if all limits are, broken if one is.
        reason: The limits that are broken or not shown, and why; empty where all are kept.
    """

    state: LimitState = LimitState.KEPT
    reason: str = ""

    @property
    def ending(self) -> RunEnding:
        """Ending of a run that found better gains."""
        return {
            LimitState.KEPT: RunEnding.TUNED,
            LimitState.NOT_SHOWN: RunEnding.LIMITS_NOT_SHOWN,
            LimitState.BROKEN: RunEnding.LIMIT_BROKEN,
        }[self.state]


def limit_verdict(
    plan: Plan, claim: Claim, gains: Gains, records: Iterable[TrialRecord]
) -> LimitVerdict:
    """Whether gains keep the limits of a plan, by what the records allow to be claimed.

    Ms and phase margin are those of the claim. The overshoot is measured: that of all records with
    these gains, without their noise.
    """
    limits = plan.limits
    if limits is None:  # a run of an earlier version is not judged
        return LimitVerdict()
    found = list(_judged(limits, claim, measured_overshoot(plan, gains, records, claim)))
    for state in (LimitState.BROKEN, LimitState.NOT_SHOWN):
        reasons = dict.fromkeys(reason for judged, reason in found if judged is state)
        if reasons:
            return LimitVerdict(state, " and ".join(reasons))
    return LimitVerdict()


def measured_overshoot(
    plan: Plan, gains: Gains, records: Iterable[TrialRecord], claim: Claim | None = None
) -> Interval | None:
    """Mean overshoot of the records with some gains, as a share of the step; None without any.

    Its 95 % interval is by Student's t. Fewer than `FEWEST_REPEATS` have the width of the interval
    that is claimed, which rests on all records, or that of `OVERSHOOT_ALLOWED`.
    """
    done = [r for r in records if r.outcome is Outcome.DONE and r.gains == gains]
    values = np.array([metrics_of(record, plan.step).overshoot for record in done])
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    mean, half = float(values.mean()), OVERSHOOT_ALLOWED
    if claim and claim.margins and math.isfinite(claim.margins.overshoot.high):
        half = max(claim.margins.overshoot.high - claim.margins.overshoot.value, 0.0)
    if values.size >= FEWEST_REPEATS:
        from scipy.special import stdtrit  # noqa: PLC0415  slow to import

        spread = float(values.std(ddof=1)) / float(np.sqrt(values.size))
        half = float(stdtrit(values.size - 1, 0.975)) * spread
    return Interval(mean, max(mean - half, 0.0), mean + half)


Judged = tuple[LimitState, str]


def _judged(
    limits: RobustnessLimits, claim: Claim, overshoot: Interval | None
) -> Iterator[Judged]:
    margins, unknown = claim.margins, f"no sensitivity is claimed from the records: {claim.reason}"
    if (limit := limits.max_sensitivity) is not None:
        yield (
            _above("sensitivity Ms", margins.sensitivity, limit, limit * SENSITIVITY_ALLOWED)
            if margins
            else (LimitState.NOT_SHOWN, unknown)
        )
    if (limit := limits.min_phase_margin_deg) is not None:
        yield (
            _below("phase margin", margins.phase_margin_deg, limit, PHASE_MARGIN_ALLOWED_deg)
            if margins
            else (LimitState.NOT_SHOWN, unknown)
        )
    if (limit := limits.max_overshoot) is not None:
        yield (
            _above("overshoot", overshoot, limit, OVERSHOOT_ALLOWED, percent=True)
            if overshoot
            else (LimitState.NOT_SHOWN, "no record shows the overshoot")
        )


def _above(
    name: str, at: Interval, limit: float, allowed: float, *, percent: bool = False
) -> Judged:
    """Judgement of a quantity with a greatest value."""
    ends = [f"{100.0 * v:.1f} %" if percent else f"{v:.2f}" for v in (at.value, at.low, at.high)]
    most = f"{100.0 * limit:.3g} %" if percent else f"{limit:g}"
    state = _state(at.low > limit + allowed, not at.high <= limit + allowed)
    return state, _reason(state, name, ends, f"above the limit of {most}")


def _below(name: str, at: Interval, limit: float, allowed: float) -> Judged:
    """Judgement of a quantity with a least value."""
    ends = [f"{value:.0f}°" for value in (at.value, at.low, at.high)]
    least = limit - allowed
    state = _state(at.high < least, not at.low >= least)
    return state, _reason(state, name, ends, f"below the limit of {limit:g}°")


def _state(is_broken: bool, may_be: bool, /) -> LimitState:  # noqa: FBT001  two facts in order
    """State of a limit that is broken for certain, or may be."""
    return LimitState.BROKEN if is_broken else LimitState.NOT_SHOWN if may_be else LimitState.KEPT


def _reason(state: LimitState, name: str, ends: Sequence[str], beyond: str) -> str:
    value, low, high = ends
    if state is LimitState.BROKEN:
        return f"the {name} of {value} is {beyond}"
    return f"the {name}, {low} to {high}, may be {beyond}" if state is LimitState.NOT_SHOWN else ""
