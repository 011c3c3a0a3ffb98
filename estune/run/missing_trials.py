"""The trials that are missing to show that confirmed gains keep the limits of a run."""

import math
from typing import NamedTuple

import numpy as np

from estune.loop_model.claim import Claim, near_trials
from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.foretold import MOST, trials_to_show
from estune.loop_model.intervals import Interval, margins_by_records
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.near_fit import TRIALS_MIN
from estune.loop_model.records import LoopRecord
from estune.run.excitation import ExcitationTrial, best_excitation
from estune.run.plan import Plan
from estune.run.planning import step_trial
from estune.trial import RigDescription


class MissingTrials(NamedTuple):
    """Trials that are missing, by the identified loop.

    Attributes:
        repeats: Repeats of the gains that would show the limits; None where none do.
        excitations: Excitations with these gains that would; None where none do.
    """

    repeats: int | None = None
    excitations: int | None = None
    excitation: ExcitationTrial | None = None

    @property
    def least(self) -> int:
        """The least number of trials that would show the limits; more than `MOST` if none do."""
        return min(count or MOST + 1 for count in (self.repeats, self.excitations))

    @property
    def next_excitation(self) -> ExcitationTrial | None:
        """The next trial, if it is an excitation; a repeat where as few of them do."""
        return None if self.repeats == self.least else self.excitation


def missing_trials(
    loop: UnknownLoop,
    claimed: Claim,
    overshoot: tuple[Interval | None, int],
    plan: Plan,
    rig: RigDescription,
) -> MissingTrials:
    """The trials that are missing where limits of Ms or overshoot are not shown to be kept.

    Args:
        loop: The identified loop with the confirmed gains.
        claimed: What is claimed of them.
        overshoot: Its interval, as a share of the step, and the number of trials that it rests on.
    """
    limits, trial = plan.limits, step_trial(rig, plan.step, plan.cost)
    if limits is None or limits.min_phase_margin_deg is not None:
        return MissingTrials()
    near = len(near_trials(loop.fit, loop.records, loop.gains))
    known = loop.margin(loop.powers.bound()).unknown is None
    if claimed.margins is None and known and near >= TRIALS_MIN:
        return MissingTrials()  # the model is wrong of these gains, and more trials tell the same
    limits = limits.tolerated
    limit, most = limits.max_sensitivity or math.inf, limits.max_overshoot
    if max(claimed.others, default=0.0) > limit:
        return MissingTrials()
    at, count = overshoot
    if claimed.margins is None and loop.fit.is_white:  # it will be the model's with the claim
        at = margins_by_records(loop.fit, loop.records, trial, loop.gains).overshoot
    of_overshoot = 0 if most is None else _repeats_to_show(at, count, most)
    first = loop.records[0]
    output, effort = setpoint_response(loop.fit.model, first, loop.gains, loop.controller)
    if of_overshoot is None or not np.isfinite(effort).all():
        return MissingTrials()
    step = LoopRecord(effort, output, first.setpoint - first.setpoint[0], loop.gains, at_rest=True)
    of_Ms = trials_to_show(loop, trial, limit, step)
    repeats = None if of_Ms is None else max(of_Ms, of_overshoot, TRIALS_MIN - near)
    best = best_excitation(loop, plan, rig)
    if best is None or of_overshoot or near < TRIALS_MIN:
        return MissingTrials(repeats)
    return MissingTrials(repeats, trials_to_show(loop, trial, limit, best.answer), best.trial)


def _repeats_to_show(at: Interval | None, repeats: int, limit: float) -> int | None:
    """Repeats that are missing to show an overshoot; None where none or too many would do."""
    if at is None or not at.value < limit or not repeats:
        return None
    needed = math.ceil(repeats * ((at.high - at.value) / (limit - at.value)) ** 2)
    return max(needed - repeats, 0) if needed <= MOST else None
