"""Whether the gains of a run keep the limits of the run, whichever tuner found them."""

import math
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from estune.core.comparison import interval_factor
from estune.core.gains import Gains
from estune.loop_model.claim import Claim
from estune.loop_model.intervals import Interval
from estune.loop_model.loop_fit import NORMAL_QUANTILE
from estune.loop_model.optimum import KEPT, RobustnessLimits
from estune.run.ending import RunEnding
from estune.run.plan import Plan
from estune.trial import TrialRecord
from estune.trial.scoring import metrics_of

PEAK_SCATTER = 0.7
"""Standard deviation of the peak of a record, in those of its noise, where repeats are few: 0.4 to
1.1 on 15 random loops with an overshoot of 3 to 7 % and noise of 0.2 to 2 % of the step."""

MEDIAN_OF_DIFFERENCE = 0.6745 * math.sqrt(2.0)
"""Median of the magnitude of a difference of two normal variables of standard deviation one."""

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

    Ms and phase margin are those of the claim. The overshoot is measured, without the noise of the
    records, or that of the claim. A limit is kept where the whole
    interval keeps it, or exceeds it by a share of `KEPT` of it at most.
    """
    limits = plan.limits
    if limits is None:  # a run of an earlier version is not judged
        return LimitVerdict()
    records = list(records)
    overshoot = measured_overshoot(plan, gains, records, claim)
    found = list(_judged(limits, claim, overshoot))
    for state in (LimitState.BROKEN, LimitState.NOT_SHOWN):
        reasons = dict.fromkeys(reason for judged, reason in found if judged is state)
        if reasons:
            return LimitVerdict(state, " and ".join(reasons))
    return LimitVerdict()


def measured_overshoot(
    plan: Plan, gains: Gains, records: Iterable[TrialRecord], claim: Claim | None = None
) -> Interval | None:
    """Mean overshoot of the records with some gains, as a share of the step; None without any.

    Its 95 % interval is by Student's t. That of fewer than `FEWEST_REPEATS` is by the noise of the
    records. The claim's rests on all records and is narrower: it takes its place where the model
    explains the records and the two agree. Else this one holds both: the peak of a flat response
    in noise is too high, and the model of friction that is not constant is wrong.
    """
    own = [r for r in records if r.gains == gains]
    peaks = np.array([metrics_of(record, plan.step).overshoot for record in own])
    known = np.isfinite(peaks)
    if not known.any():
        return None
    values, count = peaks[known], int(known.sum())
    mean, quantile = float(values.mean()), NORMAL_QUANTILE
    if count >= FEWEST_REPEATS:
        spread, quantile = float(values.std(ddof=1)), interval_factor(count - 1)
    else:
        moves = [np.diff(r.tension_N) for r, is_known in zip(own, known, strict=True) if is_known]
        # By the median: the response itself moves in less than half of the samples.
        noise = float(np.median(np.abs(np.concatenate(moves)))) / MEDIAN_OF_DIFFERENCE
        spread = PEAK_SCATTER * noise / abs(plan.step.step_N)
    load = claim.load if claim else 0.0
    half = quantile * max(spread, load) / math.sqrt(count)
    # The peak of a record is the higher the more a load moves it.
    found = Interval(mean, max(mean - half - load, 0.0), mean + half)
    told = claim.margins.overshoot if claim and claim.margins else None
    if claim is None or told is None or not math.isfinite(told.high):
        return found
    if claim.is_white and told.low <= found.high and found.low <= told.high:
        return told
    return found._replace(low=min(found.low, told.low), high=max(found.high, told.high))


Judged = tuple[LimitState, str]


def _judged(
    limits: RobustnessLimits, claim: Claim, overshoot: Interval | None
) -> Iterator[Judged]:
    margins, unknown = claim.margins, f"no sensitivity is claimed from the records: {claim.reason}"
    if (limit := limits.max_sensitivity) is not None:
        yield (
            _above("sensitivity Ms", margins.sensitivity, limit)
            if margins
            else (LimitState.NOT_SHOWN, unknown)
        )
    if (limit := limits.min_phase_margin_deg) is not None:
        yield (
            _below("phase margin", margins.phase_margin_deg, limit)
            if margins
            else (LimitState.NOT_SHOWN, unknown)
        )
    if (limit := limits.max_overshoot) is not None:
        yield (
            _above("overshoot", overshoot, limit, percent=True)
            if overshoot
            else (LimitState.NOT_SHOWN, "no record shows the overshoot")
        )


def _above(name: str, at: Interval, limit: float, *, percent: bool = False) -> Judged:
    """Judgement of a quantity with a greatest value."""
    ends = [f"{100.0 * v:.1f} %" if percent else f"{v:.2f}" for v in (at.value, at.low, at.high)]
    said, most = f"{100.0 * limit:.3g} %" if percent else f"{limit:g}", (1.0 + KEPT) * limit
    state = _state(at.low > most, not at.high <= most)
    return state, _reason(state, name, ends, f"above the limit of {said}")


def _below(name: str, at: Interval, limit: float) -> Judged:
    """Judgement of a quantity with a least value."""
    ends = [f"{value:.0f}°" for value in (at.value, at.low, at.high)]
    least = (1.0 - KEPT) * limit
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
