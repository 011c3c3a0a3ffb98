"""Is a schedule better tuned as one thing, or as a law fitted to tunings at each length?

The schedule is the paper's: I = a + b L, and P, D and the setpoint filter the same at every
length. Both ways have the same number of search trials, the same tuner, start, step and cost, and
simulated reels whose gauge noise is their own in every seed. `joint` steps in the five values of
the schedule, each proposal tried once at every length. `fitted` tunes at every length alone and
fits the law to what was found, weighted by what each tuning says of its own doubt; here all
tunings are taken, also those a sweep would leave out for having been cut short.

It is done with the gauge as it is, where the search and not the noise sets how far a budget goes,
and with a gauge four times as noisy, where what the lengths share may be worth more.

What counts is the true cost, the mean over noise that no tuning saw, at four lengths that neither
way tried, over that of the optimum at each, which a numerical search over the true cost finds.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

import estune
import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.schedule import GainCurve, GainSchedule
from estune.run.plan import MOVE_WEIGHT
from estune.studies.joint.procedure import tune_schedule
from estune.studies.law.law import fit_law
from estune.studies.law.tuned import TunedGains
from estune.support import plot_style
from experiments.judged import at_most, command_line, tell
from plants.models.reel import SAFE_GAINS, Reel

TUNER = "newton"
TENSION_N = 15.0
LENGTHS_m = {2: (0.5, 1.4), 3: (0.5, 0.95, 1.4), 5: (0.5, 0.725, 0.95, 1.175, 1.4)}
UNSEEN_m = (0.6, 0.85, 1.05, 1.3)
FORMS = {"P": "constant", "I": "linear", "D": "constant", "setpoint_filter_s": "constant"}
WAYS = ("joint 2", "joint 3", "joint 5", "fitted 2", "fitted 3", "fitted 5")
"""How, and at how many lengths."""

KINDS = ("joint", "fitted")

NOISY, NOISY_MARK = 4.0, " noisy"

FULL = (60, 120, 240, 480), (120, 240)
"""Budgets with the gauge as it is, and with the noisy one."""

MOST_EXCESS = 0.03
"""What a scheduled controller may cost at unseen lengths above one tuned there."""

DRAWS = 200
NORMAL_95 = 1.96
OUT = Path(__file__).parent / "out" / "joint_tuning.png"


@cache
def reel(length_m: float, noise: float) -> Reel:
    """The reference reel at a length, its gauge so many times as noisy."""
    usual = plants.reference_reel(length_m, TENSION_N)
    return replace(usual, gauge_noise_N=noise * usual.gauge_noise_N)


@cache
def cost() -> StepCost:
    """One cost for all lengths: the settling time of the longest."""
    times = [reel(length, 1.0).describe("", None).settling_time_s for length in LENGTHS_m[2]]
    return StepCost(max(times), move_weight=MOVE_WEIGHT)


def true_cost(length_m: float, gains: Gains, noise: float, seed: int = 70_001) -> float:
    """Mean cost over noise draws; infinite where one diverged."""
    table = np.tile(gains.as_tuple(), (DRAWS, 1))
    here = reel(length_m, noise)
    mean = plants.batch_costs(here, table, None, cost(), seed=seed, workers=1).mean()
    return float(mean) if math.isfinite(mean) else math.inf


@cache
def optimum(length_m: float, noise: float) -> float:
    """The least true cost at a length, found on other noise than it is told on."""

    def of(logs: Any) -> float:
        found = true_cost(length_m, Gains(*np.exp(logs)), noise, seed=70_002)
        return min(found, 1e3)

    start = np.log((1.2, 35.0, 0.016, 0.002))
    found = minimize(of, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-5})
    return true_cost(length_m, Gains(*np.exp(found.x)), noise)


def excess(schedule: GainSchedule, noise: float) -> float:
    """Mean over the unseen lengths of the true cost over the optimum, less one."""
    return fmean(
        true_cost(length, schedule.gains(length, TENSION_N), noise) / optimum(length, noise) - 1.0
        for length in UNSEEN_m
    )


def joint(lengths: tuple[float, ...], trials: int, seed: int, noise: float) -> GainSchedule:
    """The schedule tuned as one thing."""
    rigs = {
        length: reel(length, noise).rig(name=f"reel{n}", seed=100 * seed + n)
        for n, length in enumerate(lengths)
    }
    return tune_schedule(
        rigs, tuner=TUNER, trials=trials, repeats=2, start=SAFE_GAINS, cost=cost(), journal=False
    ).schedule


def fitted(lengths: tuple[float, ...], trials: int, seed: int, noise: float) -> GainSchedule:
    """The law fitted to tunings at each length."""
    tunings = []
    for n, length in enumerate(lengths):
        found = estune.tune(
            reel(length, noise).rig(name=f"reel{n}", seed=100 * seed + n),
            tuner=TUNER,
            trials=trials // len(lengths),
            repeats=2,
            start=SAFE_GAINS,
            cost=cost(),
            tolerance=0.0,  # every trial of the budget is used
            journal=False,
            watch=None,
        )
        state, tuner = found.session.tuner_state, found.plan.tuner
        # The search's own answer: what the repeats decide is not part of the budget.
        gains, outlook = tuner.space.gains(tuner.recommend(state)), found.plan.outlook(state)
        errors = None
        if outlook is not None:
            ends = outlook.intervals
            errors = tuple(math.log(high / low) / (2.0 * NORMAL_95) for low, high in ends)
        tunings.append(
            TunedGains(
                label=f"{length:g} m",
                length_m=length,
                tension_N=TENSION_N,
                gains=gains,
                log_errors=errors,
                cost=true_cost(length, gains, noise),
                cost_error=0.0,
                safe=True,
                converged=True,
            )
        )
    if len(lengths) == 2:
        return through_two(*(tuning.gains for tuning in tunings))
    return fit_law(tunings, forms=FORMS).schedule()


def through_two(short: Gains, long: Gains) -> GainSchedule:
    """The same form through two tunings alone, for which a law, rightly, is not fitted."""
    low, high = min(LENGTHS_m[2]), max(LENGTHS_m[2])
    values = zip(FORMS, short.as_tuple(), long.as_tuple(), strict=True)
    curves = {name: GainCurve("constant", math.sqrt(a * b)) for name, a, b in values}
    slope = (long.I - short.I) / (high - low)
    curves["I"] = GainCurve("linear", short.I - slope * low, slope)
    return GainSchedule(**curves, length_m=(low, high), tension_N=(TENSION_N, TENSION_N))


def excesses(way: str, trials: int, seeds: int, noise: float = 1.0) -> list[float]:
    """Of one way, in several seeds."""
    kind, _, count = way.partition(" ")
    run: Callable[[tuple[float, ...], int, int, float], GainSchedule]
    run = joint if kind == "joint" else fitted
    lengths = LENGTHS_m[int(count)]
    return [excess(run(lengths, trials, seed, noise), noise) for seed in range(seeds)]


def measure(
    budgets: tuple[int, ...], noisy_budgets: tuple[int, ...], seeds: int
) -> dict[str, Any]:
    """All figures by name."""
    found = {
        f"{trials}{mark}": {way: excesses(way, trials, seeds, noise) for way in WAYS}
        for mark, noise, some in (("", 1.0, budgets), (NOISY_MARK, NOISY, noisy_budgets))
        for trials in some
    }
    means = {n: {way: fmean(values) for way, values in of.items()} for n, of in found.items()}
    return {
        "seeds": seeds,
        "excess": found,
        "mean_excess": means,
        "compared": {n: compared(of) for n, of in found.items()},
    }


def compared(of: dict[str, list[float]]) -> dict[str, Any]:
    """Joint and fitted, each at its best number of lengths, seed by seed.

    The difference, joint less fitted, has Student's 95 % interval over the seeds; one that holds
    zero names no winner.
    """
    best = {
        kind: min((way for way in of if way.startswith(kind)), key=lambda way: fmean(of[way]))
        for kind in KINDS
    }
    differences = [a - b for a, b in zip(of[best["joint"]], of[best["fitted"]], strict=True)]
    n, middle = len(differences), fmean(differences)
    reach = float(stdtrit(n - 1, 0.975)) * stdev(differences) / math.sqrt(n)
    winner = "neither"
    if abs(middle) > reach:
        winner = "joint" if middle < 0.0 else "fitted"
    return {**best, "difference": middle, "half_width": reach, "winner": winner}


def show(figures: dict[str, Any]) -> None:
    """Prints the table, and says which way wins."""
    print(
        f"true cost above the optimum at unseen lengths, mean (worst) of {figures['seeds']} seeds"
    )
    print("trials     " + "".join(f"{way:>18s}" for way in WAYS))
    for trials, of in figures["excess"].items():
        cells = (f"{fmean(of[way]):.2%} ({max(of[way]):.2%})" for way in WAYS)
        print(f"{trials:>9s}  " + "".join(f"{cell:>18s}" for cell in cells))
    print()
    for trials, of in figures["compared"].items():
        print(
            f"{trials} trials: {of['winner']} wins; {of['joint']} less {of['fitted']} lengths is "
            f"{of['difference']:+.2%} +-{of['half_width']:.2%} of the optimum"
        )


def draw(figures: dict[str, Any]) -> None:
    """Saves the mean excess against the number of trials."""
    page = plot_style.new_figure(plot_style.WIDTH_in, 3.0)
    ax = page.subplots()
    budgets = [n for n in figures["mean_excess"] if not n.endswith(NOISY_MARK)]
    looks = {"joint": plot_style.BLUE, "fitted": plot_style.VERMILION}
    markers = {"2": "o", "3": "s", "5": "^"}
    for way in WAYS:
        kind, _, count = way.partition(" ")
        values = [100.0 * figures["mean_excess"][n][way] for n in budgets]
        label = f"{kind}, {count} lengths"
        ax.plot(budgets, values, marker=markers[count], color=looks[kind], label=label, lw=1.0)
    ax.set_yscale("log")
    plot_style.finish(ax, "above the optimum, %", "search trials, all lengths together")
    plot_style.legend(ax, columns=3)
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_bytes(plot_style.to_png(page))


def main() -> int:
    """Measures, prints, and says by its exit code whether every target was met."""
    options = command_line(__doc__, quick="fewer seeds and budgets").parse_args()
    figures = measure((60, 120), (), 2) if options.quick else measure(*FULL, 10)
    draw(figures)
    at_120 = figures["mean_excess"]["120"]
    best = {kind: min(v for way, v in at_120.items() if way.startswith(kind)) for kind in KINDS}
    targets = {
        f"excess_{kind}_120_trials": at_most(value, MOST_EXCESS) for kind, value in best.items()
    }
    if not options.json:
        show(figures)
    return tell(figures, targets, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
