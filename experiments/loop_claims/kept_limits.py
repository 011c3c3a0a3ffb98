"""Does a plain TUNED mean that the limits are kept, and is it said where they are?

Command: `python -m experiments.loop_claims.kept_limits`.
Target: of 200 tunings no plain TUNED whose true Ms or overshoot is above its limit by more than
1 % of it; at least 70 % plain TUNED where a linear loop is tuned.

Tunings with the default limits, one seed each, of four kinds in turn: linear plants drawn at
random, lightly damped modes, linear plants with a load step in one trial of five, and reels with
one nonlinear effect. Noise of 0.2 to 1 % of the step in the records, none on the cost beside it.
The truth is that of `truth`, by simulation of the plant, which the tuner does not see.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import plants
from estune.errors import EstuneError
from estune.loop_model.optimum import RobustnessLimits
from estune.run.ending import RunEnding
from estune.run.limit_verdict import measured_overshoot
from estune.run.results.result import from_tuning
from estune.support.blas import one_blas_thread
from estune.trial import Rig, TrialRecord, TrialRequest
from estune.trial.profiles import LoadStepProfile, StepProfile
from experiments.loop_claims.cases import OUTSIDE, LoopCase, mode_case
from experiments.loop_claims.search import tuned_run
from experiments.loop_claims.truth import TrueLoop, with_noise
from experiments.loop_prior.loops import random_plant
from experiments.results import Target, at_least, at_most, tunings_by_seed
from experiments.sample_efficiency.problems import PROBLEMS, WEAK_ON_A_REEL
from plants.simulation.simulated_rig import SimulatedRig

KINDS = ("linear", "mode", "load", "nonlinear")
LOADED, LOAD = 0.2, (0.02, 0.2)
"""Share of the trials with a load step, and its size as a share of the step."""

NOISE = (0.002, 0.01)
BEYOND = 0.01
"""Share of a limit by which a truth above it breaks the promise."""

TRIALS_MAX = 24


class LoadedRig:
    """A simulated rig on which something else adds a load in some trials, unknown to the run."""

    def __init__(self, rig: SimulatedRig, rng: np.random.Generator) -> None:
        self._rig, self._rng = rig, rng

    def run(self, request: TrialRequest) -> TrialRecord:
        """The trial, perhaps with a load step in it."""
        step, rng = request.profile, self._rng
        if not isinstance(step, StepProfile) or rng.random() > LOADED:
            return self._rig.run(request)
        span_s = step.duration_s - step.reached_at_s
        loaded = LoadStepProfile(
            **{
                name: getattr(step, name)
                for name in StepProfile.__dataclass_fields__
                if name != "kind"
            },
            load_N=rng.uniform(*LOAD) * rng.choice([-1.0, 1.0]) * step.step_N,
            load_at_s=step.reached_at_s + rng.uniform(0.1, 0.9) * span_s,
        )
        record = self._rig.run(replace(request, profile=loaded))
        return replace(record, profile=step.kind)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)


def drawn_case(seed: int) -> LoopCase:
    """The plant of a seed."""
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng([11, seed])
    if kind == "nonlinear":
        names = list(OUTSIDE)
        name = names[int(rng.integers(len(names)))]
        reel = plants.reference_reel() + OUTSIDE[name]()
        return LoopCase(name, kind, reel, PROBLEMS["friction"].cost, WEAK_ON_A_REEL)
    noise = math.exp(rng.uniform(*np.log(NOISE)))
    if kind == "mode":
        return mode_case(seed, noise)._replace(kind=kind)
    drawn, cost, _ = random_plant(rng)
    plant = with_noise(drawn, noise)
    return LoopCase(f"random {seed}", kind, plant, cost, plant.describe("rig", None).gains)


def measure(seed: int) -> dict[str, Any]:
    """The row of a seed: what was said, and what is true."""
    case = drawn_case(seed)
    row: dict[str, Any] = {"seed": seed, "kind": case.kind, "plant": case.name}
    quiet = SimulatedRig(case.plant, seed=seed, gains=case.start)
    is_loaded, rng = case.kind == "load", np.random.default_rng([12, seed])
    rig: Rig = LoadedRig(quiet, rng) if is_loaded else quiet
    try:
        run = tuned_run(rig, case, seed, TRIALS_MAX)
    except EstuneError as error:
        return row | {"ending": "refused", "why": str(error)}
    result = from_tuning(run)
    records = result.identified.undisturbed(run.recent_records)
    measured = measured_overshoot(run.plan, result.gains, records, result.claim)
    at, margins = TrueLoop(case.plant, case.cost).at(result.gains), result.claim.margins
    return row | {
        "ending": str(result.ending),
        "why": result.limits.reason if result.limits else result.message,
        "trials": len(run.entries),
        "Ms": at.sensitivity,
        "overshoot": at.overshoot,
        "cost": at.cost,
        "claimed_Ms": list(margins.sensitivity) if margins else None,
        "claimed_overshoot": list(margins.overshoot) if margins else None,
        "measured_overshoot": list(measured) if measured else None,
    }


def is_beyond(row: dict[str, Any]) -> bool:
    """Whether a plain TUNED is truly above a limit by more than `BEYOND` of it."""
    if row["ending"] != RunEnding.TUNED:
        return False
    limits = RobustnessLimits()
    most = ((row["Ms"], limits.max_sensitivity), (row["overshoot"], limits.max_overshoot))
    return any(at > (1.0 + BEYOND) * limit for at, limit in most if limit is not None)


def targets_of(rows: Sequence[dict[str, Any]]) -> dict[str, Target]:
    """The targets that the rows allow to be judged."""
    known = [row for row in rows if row["kind"] != "nonlinear" and row["ending"] != "refused"]
    plain = [row["ending"] == RunEnding.TUNED for row in known]
    return {
        "beyond": at_most(sum(is_beyond(row) for row in rows), 0),
        "plainly_tuned": at_least(float(np.mean(plain)) if plain else None, 0.7),
    }


if __name__ == "__main__":
    with one_blas_thread():  # as runs of the product do
        sys.exit(tunings_by_seed(__doc__, measure, targets_of, count=200, quick=4))
