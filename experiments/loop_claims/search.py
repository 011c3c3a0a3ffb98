"""One whole run of the model-based tuner, its trials against the truth, and what it claims."""

import math
import time
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.run.ending import RunEnding
from estune.run.journal import JournalEntry
from estune.run.loop import start
from estune.run.phase import Phase
from estune.run.planning import make_plan
from estune.run.results.result import from_tuning
from estune.run.session import after_trial, next_request, with_excitation
from estune.run.showing_limits import showing_limits
from estune.run.tuning_run import TuningRun, keep_record
from estune.trial import Rig, TrialRecord
from estune.trial.loop_records import loop_signals
from estune.trial.scoring import constraint_margin, cost_of
from experiments.loop_claims.cases import LoopCase
from experiments.loop_claims.truth import TrueLoop, Truth, true_sensitivity
from plants.simulation.simulated_rig import SimulatedRig

LIMITS_KEPT = (1.65, 0.06)
"""True Ms and overshoot up to which the limits of 1.6 and 5 % count as kept."""


class Searched(NamedTuple):
    """A run and its claim.

    Attributes:
        trials: All its trials.
        search: Those of the search.
        excitations: Excitations of the loop.
        unsafe: Trials whose true closed loop is unstable.
        ending: How it ended.
        why: What keeps it from being tuned within limits; empty where nothing does.
        excess: True cost of the gains over the constrained optimum, minus 1.
        gains: The gains to use.
        at: What is true of them.
        claimed: Interval of Ms that is claimed; NaN where none is.
        misfit: rho near the gains.
        cpu_s: Computing time of the run.
    """

    trials: int
    search: int
    excitations: int
    unsafe: int
    ending: RunEnding
    why: str
    excess: float
    gains: Gains
    at: Truth
    claimed: tuple[float, float]
    misfit: float
    cpu_s: float

    @property
    def kept(self) -> bool:
        """Whether the limits hold at the end."""
        return not (self.at.sensitivity > LIMITS_KEPT[0] or self.at.overshoot > LIMITS_KEPT[1])


def search(case: LoopCase, optimum: Truth, noise: float, seed: int, trials_max: int) -> Searched:
    """One run, of whose costs each is multiplied by noise of this relative standard deviation.

    The search has at most `trials_max` trials, the confirmation as many as it needs.
    """
    began_s = time.process_time()
    rig = SimulatedRig(case.plant, seed=seed, gains=case.start)
    run = tuned_run(rig, case, seed, trials_max, noise)
    rig.close()
    result = from_tuning(run)
    margins = result.claim.margins
    cpu_s = time.process_time() - began_s
    at = TrueLoop(case.plant, case.cost).at(result.gains)
    tried = {entry.gains for entry in run.entries}
    unsafe = {g for g in tried if not math.isfinite(true_sensitivity(case.plant, g))}
    phases = [entry.phase for entry in run.entries]
    return Searched(
        trials=len(phases),
        search=phases.count(Phase.SEARCH),
        excitations=phases.count(Phase.EXCITE),
        unsafe=sum(entry.gains in unsafe for entry in run.entries),
        ending=result.ending,
        why=result.limits.reason if result.limits else result.message,
        excess=at.cost / optimum.cost - 1.0,
        gains=result.gains,
        at=at,
        claimed=(margins.sensitivity.low, margins.sensitivity.high)
        if margins
        else (math.nan, math.nan),
        misfit=result.claim.misfit,
        cpu_s=cpu_s,
    )


def tuned_run(
    rig: Rig, case: LoopCase, seed: int, trials_max: int, noise: float = 0.0
) -> TuningRun:
    """A run to its end on a rig, with noise on the costs as of `search`."""
    description = rig.describe()
    plan = make_plan(
        description,
        f"seed{seed}",
        tuner="model_based",
        start=case.start,
        bounds=None,
        step=None,
        cost=case.cost,
        trials=trials_max,
    )
    run = start(plan, description, None)
    rng = np.random.default_rng(seed)
    while (request := next_request(run.session)) is not None:
        record = rig.run(request)
        factor = math.exp(noise * rng.standard_normal())
        advance(run, record, factor)
    return run


def advance(run: TuningRun, record: TrialRecord, factor: float) -> None:
    """Takes a trial into a run without a journal, its cost times a factor."""
    plan, rig, before = run.plan, run.description, run.session
    phase, request = before.phase, next_request(before)
    assert phase is not None and request is not None  # noqa: S101, PT018  it was run
    cost, margin = math.nan, constraint_margin(record, rig)
    if phase is not Phase.EXCITE:
        cost = factor * cost_of(record, plan.step, plan.cost, rig.newtons_per_ampere)
    signals = loop_signals(record, plan.step, rig).record
    run.session = with_excitation(after_trial(before, record.outcome, cost, margin, signals), rig)
    entry = JournalEntry(
        *(request.number, request.attempt, request.trial_id, phase, request.gains.as_tuple()),
        *(record.outcome, record.reason, cost, margin),
    )
    run.entries.append(entry)
    keep_record(run, entry, record)
    run.session = showing_limits(run)
