"""Is the law of I over cable length right, are its intervals honest, and is its schedule good?

Command: `python -m experiments.sweep_law`.
Target: slope and coverage within limits, scheduled gains about as good as gains tuned there.

The reference reel is tuned at seven lengths, a hundred times each with different noise, by
`estune.sweep` with the tuner that goes by the cost alone. A tuning minimises the expected cost: a
trial's cost is that of the gauge signal, and the gauge's noise, through P and D, moves the motor,
which costs effort. The reference is therefore the optimum of the mean cost over many noise draws,
found by the method of Nelder and Mead without any tuner.

The tables have the gains over length, means over the sweeps, and the slope of their law beside
that of the optima; the coverage of the 95 % interval of the slope of one sweep of seven tunings;
and the cost of the schedule at lengths that were not tuned, beside gains tuned there and gains of
a middle length, as means over noise that no tuning saw.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

import estune
import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.studies.law.law import GainLaw, fit_law
from estune.studies.law.tuned import TunedGains
from estune.studies.sweep.result import SweepResult
from experiments.results import Target, at_least, at_most, command_line, print_results

TENSION_N = 15.0
LENGTHS_m = (0.5, 0.65, 0.8, 0.95, 1.1, 1.25, 1.4)
UNSEEN_m = (0.575, 0.725, 0.875, 1.025, 1.175, 1.325)
OPTIMUM_SEED, TEST_SEED = 70_001, 70_002

P_RANGE = (1.0, 1.6)
SLOPE_ERROR_MAX = 0.10
COVERAGE_MIN = 0.90
OVER_TUNED_MAX = 1.03


class SweepLawExtent(NamedTuple):
    """Size of the measurement."""

    lengths_m: tuple[float, ...] = LENGTHS_m
    unseen_m: tuple[float, ...] = UNSEEN_m
    seeds: int = 100  # sweeps of one tuning for each length
    unseen_seeds: int = 10  # tunings at each unseen length
    trials: int = 200  # search trials of a tuning
    draws: int = 400  # noise draws of an expected cost


QUICK = SweepLawExtent(LENGTHS_m[::2], UNSEEN_m[1::2], seeds=8, unseen_seeds=4, draws=100)


def cost_at(length_m: float, gains: FloatArray, draws: int, seed: int) -> float:
    """Mean cost (35) of gains over noise draws."""
    reel = plants.reference_reel(length_m, TENSION_N)
    cost = default_cost(reel.describe("reel", None).settling_time_s)
    table = np.tile(gains, (draws, 1))
    mean = float(plants.batch_costs(reel, table, None, cost, seed=seed, workers=1).mean())
    return mean if np.isfinite(mean) else 1e6


@cache
def optimum(length_m: float, draws: int) -> Gains:
    """The gains of least expected cost."""
    start = np.log([1.2, 35.0, 0.016, 0.002])
    best = minimize(
        lambda x: cost_at(length_m, np.exp(x), draws, OPTIMUM_SEED),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + np.vstack([np.zeros(4), 0.15 * np.eye(4)]),
            "xatol": 1e-4,
            "fatol": 1e-7,
            "maxfev": 1000,
        },
    )
    return Gains(*np.exp(best.x).tolist())


def run_sweep(
    lengths_m: tuple[float, ...], seeds: int, trials: int, folder: Path | None
) -> SweepResult:
    """The tunings at some lengths; without a folder they are not stored."""
    design = {
        "lengths_m": list(lengths_m),
        "tensions_N": [TENSION_N],
        "rigs": ["plants:reference_reel"],
        "seeds": seeds,
        "trials": trials,
        "tuners": ["safe_bayesian"],  # by the cost alone, as the optima are
        "tolerance": 0.0,  # every tuning uses all its trials
    }
    with tempfile.TemporaryDirectory() as temporary:
        return estune.sweep(design, folder=folder or temporary, watch=None)


def of_seeds(result: SweepResult, first: int, last: int) -> list[TunedGains]:
    """The tunings of some of the seeds."""
    return [
        outcome.tuned()
        for outcome in result.outcomes
        if first <= outcome.cell.seed < last and outcome.gains is not None
    ]


def mean_gains(tunings: Sequence[TunedGains], length_m: float) -> Gains:
    """Geometric mean of the gains tuned at a length."""
    some = [t.gains.as_tuple() for t in tunings if t.length_m == length_m]
    return Gains(*np.exp(np.mean(np.log(some), axis=0)).tolist())


def unseen_costs(
    plan: SweepLawExtent, laws: Sequence[GainLaw], law: GainLaw, folder: Path | None
) -> dict[str, dict[str, float]]:
    """Mean costs at the lengths that were not tuned, by length.

    `tuned` is the mean over tunings there, `scheduled` that of the schedule of all sweeps,
    `single_p95` the 95 % quantile of those of single sweeps, `middle` of gains tuned at a middle
    length.
    """
    unseen = run_sweep(plan.unseen_m, plan.unseen_seeds, plan.trials, folder)
    tunings = of_seeds(unseen, 0, plan.unseen_seeds)
    middle = mean_gains(law.tunings, plan.lengths_m[len(plan.lengths_m) // 2])
    rows = {}
    for length in plan.unseen_m:

        def cost(gains: Gains, length: float = length) -> float:
            return cost_at(length, np.array(gains.as_tuple()), plan.draws, TEST_SEED)

        single = [cost(one.schedule().gains(length, TENSION_N)) for one in laws]
        rows[f"{length:g} m"] = {
            "optimum": cost(optimum(length, plan.draws)),
            "tuned": float(np.mean([cost(t.gains) for t in tunings if t.length_m == length])),
            "scheduled": cost(law.schedule().gains(length, TENSION_N)),
            "single_p95": float(np.quantile(single, 0.95)),
            "middle": cost(middle),
        }
    return rows


def measure(plan: SweepLawExtent, folder: Path | None) -> dict[str, Any]:
    """All figures by name."""
    result = run_sweep(plan.lengths_m, plan.seeds, plan.trials, folder)
    laws = [fit_law(of_seeds(result, n, n + 1)) for n in range(plan.seeds)]
    law = fit_law(of_seeds(result, 0, plan.seeds))
    best = [optimum(length, plan.draws) for length in plan.lengths_m]
    means = [mean_gains(law.tunings, length) for length in plan.lengths_m]
    slope = law.fits["I"].slope
    true = float(np.polyfit(plan.lengths_m, [gains.I for gains in best], 1)[0])
    slopes = [one.fits["I"].slope for one in laws]
    rows = unseen_costs(plan, laws, law, folder)
    return {
        "tunings": len(plan.lengths_m) * plan.seeds,
        "tunings_left_out": len(result.excluded),
        "slope_per_m": slope.value,
        "slope_half_width": slope.half_width,
        "slope_of_optima": true,
        "slope_off": abs(slope.value / true - 1.0),
        "covered": float(np.mean([abs(s.value - true) <= s.half_width for s in slopes])),
        "slope_half_width_of_single_sweeps": float(np.median([s.half_width for s in slopes])),
        "least_fall_of_I": -max(np.diff([g.I for g in means]).tolist()),
        "least_P": min(g.P for g in means),
        "greatest_P": max(g.P for g in means),
        "scheduled_over_tuned": max(row["scheduled"] / row["tuned"] for row in rows.values()),
        "single_scheduled_over_tuned_p95": max(
            row["single_p95"] / row["tuned"] for row in rows.values()
        ),
        "unseen": rows,
        "gains": {
            f"{length:g} m, {which}": asdict(gains)
            for which, some in (("tuned", means), ("optimum", best))
            for length, gains in zip(plan.lengths_m, some, strict=True)
        },
    }


def targets_of(figures: dict[str, Any], *, quick: bool) -> dict[str, Target]:
    """The targets; few sweeps do not determine the slope and the coverage."""
    least = {"least_fall_of_I": 0.0, "least_P": P_RANGE[0]}
    most = {
        "greatest_P": P_RANGE[1],
        "scheduled_over_tuned": OVER_TUNED_MAX,
        "single_scheduled_over_tuned_p95": OVER_TUNED_MAX,
    }
    if not quick:
        least["covered"], most["slope_off"] = COVERAGE_MIN, SLOPE_ERROR_MAX
    return {
        name: target(figures[name], limit)
        for target, limits in ((at_least, least), (at_most, most))
        for name, limit in limits.items()
    }


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    parser = command_line(__doc__, quick="fewer lengths, tunings and noise draws")
    parser.add_argument("--folder", type=Path, help="store the tunings there, to be continued")
    options = parser.parse_args()
    plan = QUICK if options.quick else SweepLawExtent()
    figures = measure(plan, options.folder)
    targets = targets_of(figures, quick=options.quick)
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
