"""Should a gain schedule be tuned as a whole, or be a law fitted to tunings at single lengths?

The schedule is the paper's: I = a + b L, and P, D and the setpoint filter the same at every
length. Both ways have the same number of search trials, the same tuner, initial gains, step and
cost, and simulated reels whose gauge noise differs in every seed. `joint` tunes the five values of
the schedule, each proposal tried once at every length. `fitted` tunes at every length alone and
fits the law to the results, weighted by their standard errors; it takes all tunings, also those
that have not converged.

The figure of merit is the true cost, the mean over noise that no tuning saw, at four lengths that
neither way tried, relative to that of a numerical optimum at each.
"""

import math
from collections.abc import Callable
from functools import cache
from statistics import fmean, stdev
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

import estune
import plants
from estune.core.cost import StepCost, default_cost
from estune.core.gains import Gains
from estune.core.schedule import GainCurve, GainSchedule
from estune.studies.law.law import fit_law
from estune.studies.law.tuned import TunedGains
from experiments.joint_schedule import tune_jointly
from experiments.results import at_most, command_line, print_results
from plants.models.reel import SAFE_GAINS, Reel

TUNER = "safe_bayesian"
TENSION_N = 15.0
LENGTHS_m = {2: (0.5, 1.4), 3: (0.5, 0.95, 1.4), 5: (0.5, 0.725, 0.95, 1.175, 1.4)}
UNSEEN_m = (0.6, 0.85, 1.05, 1.3)
FORMS = {"P": "constant", "I": "linear", "D": "constant", "setpoint_filter_s": "constant"}
WAYS = ("joint 2", "joint 3", "joint 5", "fitted 2", "fitted 3", "fitted 5")
"""Way, and number of lengths."""

BUDGETS, QUICK = (60, 120, 240, 480), (60, 120)
"""Numbers of search trials, all lengths together."""

EXCESS_MAX = 0.03
"""Limit of the excess cost at unseen lengths with 120 trials."""

DRAWS = 200
NORMAL_95 = 1.96


@cache
def reel(length_m: float) -> Reel:
    """The reference reel at a length."""
    return plants.reference_reel(length_m, TENSION_N)


@cache
def step_cost() -> StepCost:
    """One cost for all lengths, with the settling time of the longest."""
    times = [reel(length).describe("", None).settling_time_s for length in LENGTHS_m[2]]
    return default_cost(max(times))


def true_cost(length_m: float, gains: Gains, seed: int = 70_001) -> float:
    """Mean cost over noise draws; infinite if one diverged."""
    table = np.tile(gains.as_tuple(), (DRAWS, 1))
    costs = plants.batch_costs(reel(length_m), table, None, step_cost(), seed=seed, workers=1)
    mean = float(costs.mean())
    return mean if math.isfinite(mean) else math.inf


@cache
def optimum(length_m: float) -> float:
    """The least true cost at a length, found with other noise than it is evaluated with."""

    def objective(logs: Any) -> float:
        return min(true_cost(length_m, Gains(*np.exp(logs)), seed=70_002), 1e3)

    start = np.log((1.2, 35.0, 0.016, 0.002))
    options = {"xatol": 1e-3, "fatol": 1e-5}
    best = minimize(objective, start, method="Nelder-Mead", options=options)
    return true_cost(length_m, Gains(*np.exp(best.x)))


def excess(schedule: GainSchedule) -> float:
    """Mean over the unseen lengths of the true cost relative to the optimum, less one."""
    return fmean(
        true_cost(length, schedule.gains(length, TENSION_N)) / optimum(length) - 1.0
        for length in UNSEEN_m
    )


def joint(lengths: tuple[float, ...], trials: int, seed: int) -> GainSchedule:
    """The schedule tuned as a whole."""
    rigs = {
        length: reel(length).rig(name=f"reel{n}", seed=100 * seed + n)
        for n, length in enumerate(lengths)
    }
    return tune_jointly(rigs, TUNER, trials, SAFE_GAINS, step_cost())


def fitted(lengths: tuple[float, ...], trials: int, seed: int) -> GainSchedule:
    """The law fitted to tunings at each length."""
    tunings = [
        _tuned(length, trials // len(lengths), 100 * seed + n) for n, length in enumerate(lengths)
    ]
    if len(lengths) == 2:
        return through_two(*(tuning.gains for tuning in tunings))
    return fit_law(tunings, forms=FORMS).schedule()


def _tuned(length: float, trials: int, seed: int) -> TunedGains:
    """The search's own recommendation: the repeats that confirm it are not in the budget."""
    result = estune.tune(
        reel(length).rig(name="reel", seed=seed), tuner=TUNER, trials=trials, repeats=2,
        start=SAFE_GAINS, cost=step_cost(), journal=False, watch=None,
        tolerance=0.0,  # every trial of the budget is used
    )  # fmt: skip
    state, tuner = result.session.tuner_state, result.plan.tuner
    gains, estimate = tuner.space.gains(tuner.recommend(state)), result.plan.convergence(state)
    errors = None
    if estimate is not None:
        errors = tuple(math.log(hi / lo) / (2.0 * NORMAL_95) for lo, hi in estimate.intervals)
    return TunedGains(
        f"{length:g} m", length, TENSION_N, gains, errors,
        cost=true_cost(length, gains), cost_error=0.0, safe=True, converged=True,
    )  # fmt: skip


def through_two(short: Gains, long: Gains) -> GainSchedule:
    """The schedule through two tunings alone, which are too few to fit a law."""
    low, high = LENGTHS_m[2]
    values = zip(FORMS, short.as_tuple(), long.as_tuple(), strict=True)
    curves = {name: GainCurve("constant", math.sqrt(a * b)) for name, a, b in values}
    slope = (long.I - short.I) / (high - low)
    curves["I"] = GainCurve("linear", short.I - slope * low, slope)
    return GainSchedule(**curves, length_m=(low, high), tension_N=(TENSION_N, TENSION_N))


def measure(budgets: tuple[int, ...], seeds: int) -> dict[str, Any]:
    """All figures by name."""
    ways: dict[str, Callable[..., GainSchedule]] = {"joint": joint, "fitted": fitted}
    excesses: dict[str, dict[str, list[float]]] = {}
    for trials in budgets:
        of = excesses[str(trials)] = {}
        for way in WAYS:
            kind, _, count = way.partition(" ")
            lengths = LENGTHS_m[int(count)]
            of[way] = [excess(ways[kind](lengths, trials, seed)) for seed in range(seeds)]
    return {
        "seeds": seeds,
        "excess": excesses,
        "mean_excess": {n: {w: fmean(v) for w, v in of.items()} for n, of in excesses.items()},
        "compared": {n: compare(of) for n, of in excesses.items()},
    }


def compare(of: dict[str, list[float]]) -> dict[str, Any]:
    """Joint less fitted, each at its best number of lengths, seed by seed.

    The difference has Student's 95 % interval; if that contains zero, neither wins.
    """
    best = {
        kind: min((way for way in of if way.startswith(kind)), key=lambda way: fmean(of[way]))
        for kind in ("joint", "fitted")
    }
    differences = [a - b for a, b in zip(of[best["joint"]], of[best["fitted"]], strict=True)]
    n, mean = len(differences), fmean(differences)
    half = float(stdtrit(n - 1, 0.975)) * stdev(differences) / math.sqrt(n)
    winner = "neither"
    if abs(mean) > half:
        winner = "joint" if mean < 0.0 else "fitted"
    return {**best, "difference": mean, "half_width": half, "winner": winner}


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    options = command_line(__doc__, quick="fewer seeds and budgets").parse_args()
    figures = measure(QUICK, 2) if options.quick else measure(BUDGETS, 10)
    at_120 = figures["mean_excess"]["120"]
    targets = {
        f"excess_{kind}_120_trials": at_most(
            min(value for way, value in at_120.items() if way.startswith(kind)), EXCESS_MAX
        )
        for kind in ("joint", "fitted")
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
