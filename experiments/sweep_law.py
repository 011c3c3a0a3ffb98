"""Is the law of I over cable length right, are its intervals honest, and does its schedule serve?

The reference reel is tuned at seven lengths, a hundred times each with noise of its own, by
`estune.sweep` with its usual tuner. What a tuning looks for is the least expected cost: a trial is
scored on what the gauge reads, and the gauge's noise, through P and D, moves the motor, which
costs effort. The reference is therefore the optimum of the mean cost over many noise draws, found
by Nelder and Mead's method without any tuner; the optimum without noise stands beside it, and lies
elsewhere.

Told are: the gains over length, means over the sweeps, and the slope of their law beside that of
the optima; how often the 95 % interval of the slope of one sweep of seven tunings covers the slope
of the optima; what the schedule costs at lengths that were not tuned at, beside gains tuned there
and beside fixed gains, each as the mean over noise draws that no tuning saw; and how the tension
fares while the cable's end moves from the shortest length to the longest.
"""

import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

import estune
import plants
from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.quantities import FloatArray
from estune.core.schedule import GainSchedule
from estune.run.plan import MOVE_WEIGHT
from estune.studies.law.law import GainLaw, fit_law
from estune.studies.law.tuned import TunedGains
from estune.studies.sweep.result import SweepResult
from estune.support import plot_style
from estune.trial.profiles import StepProfile
from experiments.judged import Target, at_least, at_most, command_line, tell

TENSION_N = 15.0
LENGTHS_m = (0.5, 0.65, 0.8, 0.95, 1.1, 1.25, 1.4)
UNSEEN_m = (0.575, 0.725, 0.875, 1.025, 1.175, 1.325)
OPTIMUM_SEED, JUDGE_SEED = 70_001, 70_002
OUT = Path(__file__).parent / "out" / "sweep_law.png"

P_RANGE = (1.0, 1.6)
MOST_OFF_SLOPE = 0.10
LEAST_COVERED = 0.90
MOST_ABOVE_TUNED = 1.03


class Plan(NamedTuple):
    """How much is run.

    Attributes:
        lengths_m: Lengths of the sweep.
        unseen_m: Lengths at which the schedule is judged.
        seeds: Sweeps of one tuning a length; the law told is that of all together.
        there: Tunings at each unseen length.
        trials: Search trials of a tuning.
        draws: Noise draws that an expected cost is the mean of.
    """

    lengths_m: tuple[float, ...] = LENGTHS_m
    unseen_m: tuple[float, ...] = UNSEEN_m
    seeds: int = 100
    there: int = 10
    trials: int = 200
    draws: int = 400


QUICK = Plan(LENGTHS_m[::2], UNSEEN_m[1::2], seeds=8, there=4, draws=100)


def cost_at(length_m: float, gains: FloatArray, draws: int, seed: int) -> float:
    """Mean cost (35) of gains over so many noise draws; with none, the cost without noise."""
    reel = plants.reference_reel(length_m, TENSION_N)
    cost = StepCost(reel.describe("reel", None).settling_time_s, move_weight=MOVE_WEIGHT)
    table, noise = np.tile(gains, (max(draws, 1), 1)), seed if draws else None
    mean = float(plants.batch_costs(reel, table, None, cost, seed=noise, workers=1).mean())
    return mean if np.isfinite(mean) else 1e6


@cache
def optimum(length_m: float, draws: int) -> Gains:
    """The gains of least expected cost, or with no draws of least cost without noise."""
    start = np.log([1.2, 35.0, 0.016, 0.002])
    found = minimize(
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
    return Gains(*np.exp(found.x).tolist())


def slope_of(lengths_m: Sequence[float], gains: Sequence[Gains]) -> float:
    """Slope of the straight line through I over length, 1/s per m."""
    return float(np.polyfit(lengths_m, [g.I for g in gains], 1)[0])


def swept(
    lengths_m: tuple[float, ...], seeds: int, trials: int, folder: Path | None
) -> SweepResult:
    """The tunings at these lengths; without a folder they are not kept."""
    design = {
        "lengths_m": list(lengths_m),
        "tensions_N": [TENSION_N],
        "rigs": ["plants:reference_reel"],
        "seeds": seeds,
        "trials": trials,
        "tolerance": 0.0,  # all of them, so that tunings are alike in effort
    }
    with tempfile.TemporaryDirectory() as temporary:
        return estune.sweep(design, folder=folder or temporary, watch=None)


def of_seeds(result: SweepResult, first: int, last: int) -> list[TunedGains]:
    """The tunings of some of the seeds."""
    return [
        tuned
        for outcome in result.outcomes
        if first <= outcome.cell.seed < last and (tuned := outcome.tuned()) is not None
    ]


def mean_gains(tunings: Sequence[TunedGains], length_m: float) -> Gains:
    """Geometric mean of the gains tuned at a length."""
    some = [t.gains.as_tuple() for t in tunings if t.length_m == length_m]
    return Gains(*np.exp(np.mean(np.log(some), axis=0)).tolist())


class Judged(NamedTuple):
    """Mean costs at an unseen length.

    Attributes:
        length_m: The length.
        optimum: Of the optimum there.
        tuned: Of gains tuned there, the mean over their tunings.
        scheduled: Of the schedule of the sweeps together.
        single: Of the schedule of each single sweep.
        fixed: Of gains tuned at the shortest, a middle and the longest length of the sweep.
    """

    length_m: float
    optimum: float
    tuned: float
    scheduled: float
    single: FloatArray
    fixed: tuple[float, float, float]


def judge(plan: Plan, laws: Sequence[GainLaw], law: GainLaw, folder: Path | None) -> list[Judged]:
    """What the schedules cost at lengths that were not tuned at."""
    there = swept(plan.unseen_m, plan.there, plan.trials, folder)
    tunings = of_seeds(there, 0, plan.there)
    at = (plan.lengths_m[0], plan.lengths_m[len(plan.lengths_m) // 2], plan.lengths_m[-1])
    fixed = [mean_gains(law.tunings, length) for length in at]
    schedules = [one.schedule() for one in laws]
    rows = []
    for length in plan.unseen_m:

        def cost(gains: Gains, length: float = length) -> float:
            return cost_at(length, np.array(gains.as_tuple()), plan.draws, JUDGE_SEED)

        rows.append(
            Judged(
                length,
                optimum=cost(optimum(length, plan.draws)),
                tuned=float(np.mean([cost(t.gains) for t in tunings if t.length_m == length])),
                scheduled=cost(law.schedule().gains(length, TENSION_N)),
                single=np.array([cost(s.gains(length, TENSION_N)) for s in schedules]),
                fixed=(cost(fixed[0]), cost(fixed[1]), cost(fixed[2])),
            )
        )
    return rows


def moving(schedule: GainSchedule) -> dict[str, float]:
    """Root mean square of the tension's error while the cable's end moves, N, by gains."""
    reel, hold = plants.reference_reel(), StepProfile(15.0, 10.0, 0.2, 4.0)
    low, high = schedule.length_m
    samples = hold.samples(reel.sampling_Hz)
    along = np.clip((np.arange(samples) / samples - 0.2) / 0.6, 0.0, 1.0)
    length = low + (high - low) * (along - np.sin(2.0 * np.pi * along) / (2.0 * np.pi))
    moves = slice(int(0.2 * samples), int(0.8 * samples))
    errors = {}
    for name, gains in (
        ("scheduled", schedule),
        ("of the shortest", schedule.gains(low, TENSION_N)),
        ("of the longest", schedule.gains(high, TENSION_N)),
    ):
        found = plants.simulate_moving(reel, gains, length, hold)
        errors[name] = float(np.std((found.tension_N - found.setpoint_N)[moves]))
    return errors


class Found(NamedTuple):
    """Everything measured."""

    law: GainLaw
    laws: list[GainLaw]
    left_out: int
    rows: list[Judged]
    moving: dict[str, float]


def measure(plan: Plan, folder: Path | None) -> Found:
    """Tunes, fits and judges."""
    result = swept(plan.lengths_m, plan.seeds, plan.trials, folder)
    laws = [fit_law(of_seeds(result, n, n + 1)) for n in range(plan.seeds)]
    law = fit_law(of_seeds(result, 0, plan.seeds))
    rows = judge(plan, laws, law, folder)
    return Found(law, laws, len(result.excluded), rows, moving(law.schedule()))


def figures_of(plan: Plan, found: Found) -> dict[str, float]:
    """All figures by name."""
    best = [optimum(length, plan.draws) for length in plan.lengths_m]
    clean = [optimum(length, 0) for length in plan.lengths_m]
    means = [mean_gains(found.law.tunings, length) for length in plan.lengths_m]
    slope, true = found.law.fits["I"].slope, slope_of(plan.lengths_m, best)
    slopes = [one.fits["I"].slope for one in found.laws]
    figures: dict[str, float] = {
        "tunings": len(plan.lengths_m) * plan.seeds,
        "tunings_left_out": found.left_out,
        "slope_per_m": slope.value,
        "slope_half_width": slope.half_width,
        "slope_of_optima": true,
        "slope_of_optima_without_noise": slope_of(plan.lengths_m, clean),
        "slope_off": abs(slope.value / true - 1.0),
        "covered": float(np.mean([abs(s.value - true) <= s.half_width for s in slopes])),
        "slope_scatter_of_single_sweeps": float(np.std([s.value for s in slopes], ddof=1)),
        "slope_bias_of_single_sweeps": float(np.mean([s.value for s in slopes])) - true,
        "slope_half_width_of_single_sweeps": float(np.median([s.half_width for s in slopes])),
        "least_fall_of_I": -max(np.diff([g.I for g in means]).tolist()),
        "least_P": min(g.P for g in means),
        "greatest_P": max(g.P for g in means),
        "scheduled_over_tuned": max(row.scheduled / row.tuned for row in found.rows),
        "single_scheduled_over_tuned_p95": max(
            float(np.quantile(row.single, 0.95)) / row.tuned for row in found.rows
        ),
        "tuned_over_optimum": max(row.tuned / row.optimum for row in found.rows),
    }
    for n, name in enumerate(("shortest", "middle", "longest")):
        figures[f"fixed_{name}_over_tuned"] = max(row.fixed[n] / row.tuned for row in found.rows)
    for length, ours, theirs, quiet in zip(plan.lengths_m, means, best, clean, strict=True):
        for name in GAIN_NAMES:
            figures[f"{name}_{length:g}"] = getattr(ours, name)
            figures[f"{name}_{length:g}_optimum"] = getattr(theirs, name)
            figures[f"{name}_{length:g}_optimum_without_noise"] = getattr(quiet, name)
    for name, error in found.moving.items():
        figures[f"moving_error_N_{name.replace(' ', '_')}"] = error
    return figures


def targets_of(figures: dict[str, float], *, quick: bool) -> dict[str, Target]:
    """The targets; few sweeps tell neither the slope to a tenth nor how often intervals cover."""
    least = {"least_fall_of_I": 0.0, "least_P": P_RANGE[0]}
    most = {
        "greatest_P": P_RANGE[1],
        "scheduled_over_tuned": MOST_ABOVE_TUNED,
        "single_scheduled_over_tuned_p95": MOST_ABOVE_TUNED,
    }
    if not quick:
        least["covered"], most["slope_off"] = LEAST_COVERED, MOST_OFF_SLOPE
    return {
        name: judge(figures[name], limit)
        for judge, limits in ((at_least, least), (at_most, most))
        for name, limit in limits.items()
    }


def draw(plan: Plan, found: Found) -> None:
    """Fig. 14 with the optima, and the costs at unseen lengths."""
    figure, (ax, below) = plot_style.stacked(2, 6.0)
    length = np.linspace(plan.lengths_m[0], plan.lengths_m[-1], 100)
    band = found.law.band("I", length)
    ax.fill_between(length, band.low, band.high, color=plot_style.LIGHT, label="95 % of the law")
    fit = found.law.fits["I"]
    ax.plot(length, band.gain, color=plot_style.BLUE, lw=1.4, label=f"I = {fit.curve}")
    tuned = fit.points
    ax.plot(tuned.length_m, tuned.gain, ".", color=plot_style.GREY, ms=4, label="tunings")
    for draws, colour, label in (
        (plan.draws, plot_style.VERMILION, "optimum of the expected cost"),
        (0, plot_style.GREEN, "optimum without gauge noise"),
    ):
        best = [optimum(at, draws).I for at in plan.lengths_m]
        ax.plot(plan.lengths_m, best, "D", color=colour, ms=4.5, label=label)
    plot_style.finish(ax, "I, 1/s")
    plot_style.legend(ax, columns=3)
    at = [row.length_m for row in found.rows]
    for label, colour, values in (
        ("scheduled", plot_style.BLUE, [row.scheduled / row.optimum for row in found.rows]),
        ("tuned there", plot_style.GREY, [row.tuned / row.optimum for row in found.rows]),
        ("fixed: shortest", plot_style.ORANGE, [row.fixed[0] / row.optimum for row in found.rows]),
        ("fixed: middle", plot_style.GREEN, [row.fixed[1] / row.optimum for row in found.rows]),
        ("fixed: longest", plot_style.PURPLE, [row.fixed[2] / row.optimum for row in found.rows]),
    ):
        below.plot(at, values, "o-", color=colour, ms=4, lw=1.0, label=label)
    plot_style.finish(below, "cost over that of the optimum", "cable length, m")
    plot_style.legend(below, columns=5)
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_bytes(plot_style.to_png(figure))


def show(plan: Plan, found: Found, figures: dict[str, float]) -> None:
    """Prints the tables."""
    print(f"{found.law.sentence}.")
    for remark in found.law.remarks:
        print(f"  {remark}")
    heads = ("L, m", "P", "optimum", "no noise", "I", "optimum", "no noise")
    print("\n" + " ".join(f"{head:>8}" for head in heads))
    for length in plan.lengths_m:
        P, I = (
            [figures[f"{name}_{length:g}{which}"] for which in _COLUMNS] for name in ("P", "I")
        )
        print(f"{length:8g} " + " ".join(f"{value:8.3f}" for value in (*P, *I)))
    print(
        f"\nslope of I, 1/s per m: law {figures['slope_per_m']:.2f} "
        f"±{figures['slope_half_width']:.2f}, optima {figures['slope_of_optima']:.2f}, "
        f"without noise {figures['slope_of_optima_without_noise']:.2f}"
    )
    print(
        f"single sweeps: interval ±{figures['slope_half_width_of_single_sweeps']:.2f} (median), "
        f"scatter {figures['slope_scatter_of_single_sweeps']:.2f}, bias "
        f"{figures['slope_bias_of_single_sweeps']:+.2f}, covered {figures['covered']:.0%} of "
        f"{plan.seeds}"
    )
    heads = ("L, m", "optimum", "tuned", "schedule", "shortest", "middle", "longest")
    print("\n" + " ".join(f"{head:>8}" for head in heads))
    for row in found.rows:
        costs = (row.optimum, row.tuned, row.scheduled, *row.fixed)
        print(f"{row.length_m:8g} " + " ".join(f"{cost:8.4f}" for cost in costs))
    print(
        "schedule of a single sweep, 95 % of them: at most "
        f"{figures['single_scheduled_over_tuned_p95']:.4f} of the cost of gains tuned there"
    )
    moved = ", ".join(f"{name} {error:.3f}" for name, error in found.moving.items())
    print(f"\ntension error while the cable's end moves, N rms: {moved}")


_COLUMNS = ("", "_optimum", "_optimum_without_noise")


def main() -> int:
    """Measures, prints, and says by its exit code whether every target was met."""
    parser = command_line(__doc__, quick="fewer lengths, tunings and noise draws")
    parser.add_argument(
        "--folder", type=Path, help="keep the tunings there; a call that was cut off goes on"
    )
    options = parser.parse_args()
    plan = QUICK if options.quick else Plan()
    found = measure(plan, options.folder)
    figures = figures_of(plan, found)
    draw(plan, found)
    if not options.json:
        show(plan, found, figures)
        print(f"figure: {OUT}")
    return tell(figures, targets_of(figures, quick=options.quick), as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
