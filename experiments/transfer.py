"""How soon is a new reel tuned from the law of five others, and from its own linear model?

Command: `python -m experiments.transfer`.
Target: the first trial within 5 % of the optimum in 95 % of cases, at most 6 search trials, none
unsafe.

Five reels of 0.5 to 1.4 m whose inertias differ by up to 20 % are tuned from their safe gains.
Four new ones, of other lengths and inertias, are then tuned from the law of the first five, from
the optimum of their own linear model, and from their safe gains. The excess of a trial is that of
its expected cost over the optimum within the limits of the reel's own equations.
"""

import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import estune
import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.loop_model.optimum import RobustnessLimits
from estune.run.planning import known_start
from estune.run.results.result import TuneResult
from estune.run.session import Phase
from experiments.loop_claims import true_sensitivity
from experiments.results import at_least, at_most, command_line, print_results
from plants.models.reel import Reel

EARLIER = ((0.5, 1.0), (0.7, 0.9), (0.9, 1.2), (1.15, 0.8), (1.4, 1.1))
NEW = ((0.6, 0.85), (0.8, 1.2), (1.05, 1.1), (1.3, 0.9))
"""Cable length, m, and inertia over that of the reference reel."""

NOISE_DRAWS = 32
WITHIN = 0.05


class TransferRun(NamedTuple):
    """A tuning of a new reel.

    Attributes:
        excess: Excess of each search trial over the constrained optimum.
        start_excess: Of the initial gains.
        end_excess: Of the gains to use.
        sensitivity: Their Ms by the reel's own linear model.
        unsafe: Unsafe trials.
    """

    excess: tuple[float, ...]
    start_excess: float
    end_excess: float
    sensitivity: float
    unsafe: int

    @property
    def first_within(self) -> float:
        """The first trial within 5 % of the optimum, the initial gains being the first."""
        within = [n for n, e in enumerate((self.start_excess, *self.excess), 1) if e <= WITHIN]
        return min(within, default=math.inf)


def reel(length_m: float, inertia: float) -> Reel:
    """A reel with so many times the inertia of the reference."""
    plain = plants.reference_reel(cable_length_m=length_m)
    return replace(plain, drum_inertia_kg_m2=inertia * plain.drum_inertia_kg_m2)


def expected_cost(plant: Reel, gains: Gains) -> float:
    """Mean cost of gains over draws of the noise."""
    cost = default_cost(plant.describe("reel", None).settling_time_s)
    table = np.tile(gains.as_tuple(), (NOISE_DRAWS, 1))
    return float(plants.batch_costs(plant, table, None, cost, seed=70_001, workers=1).mean())


def tuned(plant: Reel, seed: int, **how: Any) -> TuneResult:
    """A model-based tuning of a reel."""
    return estune.tune(plant.rig(seed=seed), tuner="model_based", watch=None, **how)


def measured(plant: Reel, result: TuneResult) -> TransferRun:
    """The figures of a tuning of a new reel."""
    about = plant.describe("reel", None)
    cost = default_cost(about.settling_time_s)
    best = known_start("model", about, about.step, cost, RobustnessLimits()).gains
    least = expected_cost(plant, best)

    def excess(gains: Gains) -> float:
        return expected_cost(plant, gains) / least - 1.0

    searched = [e.gains for e in result.entries if e.phase is Phase.SEARCH]
    return TransferRun(
        tuple(map(excess, searched)),
        excess(result.start_gains),
        excess(result.gains),
        true_sensitivity(plant, result.gains),
        result.unsafe,
    )


def row(runs: list[TransferRun]) -> dict[str, float]:
    """The figures of several tunings."""
    return {
        "first_within_5_%_median": float(np.median([r.first_within for r in runs])),
        "first_within_5_%_worst": max(r.first_within for r in runs),
        "first_trial_within_5_%_share": float(np.mean([r.first_within == 1.0 for r in runs])),
        "first_trial_excess_worst": max(r.start_excess for r in runs),
        "search_trials_median": float(np.median([len(r.excess) for r in runs])),
        "search_trials_worst": max(len(r.excess) for r in runs),
        "end_excess_worst": max(r.end_excess for r in runs),
        "Ms_worst": max(r.sensitivity for r in runs),
        "unsafe": sum(r.unsafe for r in runs),
    }


def main() -> int:
    """Prints a row for each kind of start."""
    options = command_line(__doc__, quick="one seed in place of ten, two new reels").parse_args()
    new = NEW[::3] if options.quick else NEW
    starts: dict[str, list[TransferRun]] = {"law": [], "model": [], "own": []}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1 if options.quick else 10):
            earlier = Path(folder) / f"seed-{seed}"
            for n, place in enumerate(EARLIER):
                tuned(reel(*place), 100 * seed + n, folder=earlier, run=f"reel-{n}")
            law = estune.start_from(f"law:{earlier}")
            for n, place in enumerate(new):
                plant = reel(*place)
                for name, start in (("law", law), ("model", "model"), ("own", None)):
                    result = tuned(plant, 100 * seed + 50 + n, start=start, journal=False)
                    starts[name].append(measured(plant, result))
    figures = {name: row(runs) for name, runs in starts.items()}
    known = [figures["law"], figures["model"]]
    targets = {
        "first_trial_within_5_%_share": at_least(
            min(f["first_trial_within_5_%_share"] for f in known), 0.95
        ),
        "search_trials_worst": at_most(max(f["search_trials_worst"] for f in known), 6.0),
        "unsafe": at_most(sum(f["unsafe"] for f in known), 0.0),
    }
    return print_results({"starts": figures}, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
