"""What is claimed of loops that are mildly nonlinear or change, and is it true?

Command: `python -m experiments.loop_claims.mild`.
Target: of 60 tunings 75 % plainly TUNED, the true Ms and overshoot inside 95 % of the intervals
claimed, no plain TUNED truly above a limit by more than 1 % of it.

Tunings with the default limits of the loops of `mild_loops`, whose true Ms is that of the linear
part at the end of the step, and whose true overshoot is that of a step without noise and load.
"""

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import estune
from estune.errors import EstuneError
from estune.run.ending import RunEnding
from estune.run.limit_verdict import measured_overshoot
from estune.support.blas import one_blas_thread
from experiments.loop_claims.kept_limits import is_beyond
from experiments.loop_claims.mild_loops import MildRig, drawn
from experiments.results import Target, at_least, at_most, tunings_by_seed


def measure(seed: int) -> dict[str, Any]:
    """The row of a seed: what was said, and what is true."""
    loop = drawn(seed)
    rig, row, began_s = MildRig(loop, seed), {"seed": seed, "kind": loop.name}, time.process_time()
    try:
        result = estune.tune(rig, journal=False, watch=None)
    except EstuneError as error:
        return row | {"ending": "refused", "why": str(error)}
    cpu_s, margins = time.process_time() - began_s, result.claim.margins
    records = result.identified.undisturbed(result.recent_records)
    shown = measured_overshoot(result.plan, result.gains, records, result.claim)
    return row | {
        "ending": str(result.ending),
        "why": result.limits.reason if result.limits else result.message,
        "trials": rig.trials,
        "cpu_s": cpu_s,
        "Ms": loop.sensitivity(result.gains, rig.trials),
        "overshoot": loop.overshoot(result.gains, rig.trials),
        "claimed_Ms": list(margins.sensitivity) if margins else None,
        "shown_overshoot": list(shown) if shown else None,
    }


def is_inside(row: dict[str, Any]) -> bool:
    """Whether the claimed intervals hold the truth: of Ms, and of the overshoot of the trials."""
    pairs = ((row["Ms"], row["claimed_Ms"]), (row["overshoot"], row["shown_overshoot"]))
    return all(at is None or at[1] <= true <= at[2] for true, at in pairs)


def targets_of(rows: Sequence[dict[str, Any]]) -> dict[str, Target]:
    """The targets, each of all rows."""
    tuned = [row["ending"] == RunEnding.TUNED for row in rows]
    claimed = [row for row in rows if row.get("claimed_Ms")]
    inside = float(np.mean([is_inside(row) for row in claimed])) if claimed else None
    return {
        "plainly_tuned": at_least(float(np.mean(tuned)), 0.75),
        "inside": at_least(inside, 0.95),
        "beyond": at_most(sum(is_beyond(row) for row in rows), 0),
    }


if __name__ == "__main__":
    with one_blas_thread():  # as runs of the product do
        sys.exit(tunings_by_seed(__doc__, measure, targets_of, count=18, quick=2))
