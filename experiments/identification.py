"""Are the parameters of a reel identified from noisy records, and do the intervals hold?

Command: `python -m experiments.identification`.
Target: worst errors of 0.5 % (resonance), 5 % (damping), 10 % (dead time); coverage of 95 % within
chance.

The reference reel is excited in open loop about its preload by a multisine of ten seconds, two of
them to settle, at four lengths and four tensions, each with many seeds. Estimates are compared
with the reel's parameters.
"""

import math
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed

from experiments.paper.identify import (
    BroadbandExcitation,
    SecondOrderFit,
    fit_second_order,
    open_loop_record,
    response_of_record,
)
from experiments.paper.identify.conditions import (
    SAMPLING_HZ,
    TENSIONS_N,
    LENGTHS_m,
    excitation,
)
from experiments.results import Target, at_most, command_line, print_results
from plants.models.reel import Reel, reference_reel
from plants.models.reel_equations import viscous_friction_Nms

PROBABILITY = 0.95
LIMITS = {"resonance": 0.005, "damping": 0.05, "dead_time": 0.1}
SIGMAS = 3.29
"""Standard deviations exceeded once in a thousand times."""


class Trial(NamedTuple):
    """Comparison of one fit with the true parameters, by quantity.

    Attributes:
        error: Relative error; of the dead time, error in samples.
        covered: Whether the interval contains the true value.
        half_width: Half width of the interval, in the units of `error`.
    """

    error: dict[str, float]
    covered: dict[str, bool]
    half_width: dict[str, float]


def conditions() -> list[Reel]:
    """Four lengths by four tensions, and a reel with a fractional dead time."""
    grid = [reference_reel(L, T) for L in LENGTHS_m for T in TENSIONS_N]
    return [*grid, reference_reel(0.8, 15.0, dead_time_s=1.37 / SAMPLING_HZ)]


def identify(reel: Reel, signal: BroadbandExcitation, seed: int) -> SecondOrderFit:
    """Fit of one record."""
    record = open_loop_record(reel, signal, seed)
    return fit_second_order(response_of_record(record, signal), probability=PROBABILITY)


def compare(reel: Reel, fit: SecondOrderFit) -> Trial:
    """Comparison of a fit with the reel's parameters."""
    w = reel.natural_frequency_rad_s
    zeta = viscous_friction_Nms(reel) / (2.0 * reel.drum_inertia_kg_m2 * w)
    pairs = {
        "resonance": (fit.resonance_Hz, w * math.sqrt(1.0 - 2.0 * zeta**2) / (2.0 * math.pi)),
        "damping": (fit.damping, zeta),
        "dead_time": (fit.dead_time_s, reel.dead_time_s),
        "gain": (fit.gain, reel.newtons_per_ampere),
        "gauge_frequency": (fit.gauge_Hz, reel.gauge_Hz),
        "gauge_damping": (fit.gauge_damping, reel.gauge_damping),
    }
    error, covered, half_width = {}, {}, {}
    for name, (estimate, true) in pairs.items():
        if estimate is None:
            continue
        unit = 1.0 / SAMPLING_HZ if name == "dead_time" else true
        error[name] = (estimate.value - true) / unit
        covered[name] = estimate.low <= true <= estimate.high
        half_width[name] = (estimate.high - estimate.low) / (2.0 * unit)
    return Trial(error, covered, half_width)


def repeat(signal: BroadbandExcitation, reel: Reel, seeds: range) -> list[Trial]:
    """Trials of one condition with many seeds."""
    return [compare(reel, identify(reel, signal, seed)) for seed in seeds]


def study(
    reels: list[Reel], signal: BroadbandExcitation, seeds: int, jobs: int
) -> list[list[Trial]]:
    """Trials of all conditions, each with its own seeds, in so many processes; -1 is all cores."""
    ranges = [range(seeds * n, seeds * (n + 1)) for n in range(len(reels))]
    todo = zip(reels, ranges, strict=True)
    return list(Parallel(n_jobs=jobs)(delayed(repeat)(signal, *one) for one in todo))


def accuracy(reels: list[Reel], trials: list[list[Trial]]) -> dict[str, dict[str, float]]:
    """Worst error and median half width of the intervals of each condition.

    Errors are relative; that of the dead time is in samples.
    """
    rows = {}
    for reel, repeats in zip(reels, trials, strict=True):
        samples = reel.dead_time_s * SAMPLING_HZ
        rows[f"{reel.cable_length_m:g} m, {reel.tension_N:g} N, {samples:.2f} samples"] = {
            **{name: max(abs(t.error[name]) for t in repeats) for name in LIMITS},
            **{
                f"{name}_half_width": float(np.median([t.half_width[name] for t in repeats]))
                for name in LIMITS
            },
        }
    return rows


def coverage(trials: list[list[Trial]]) -> dict[str, float]:
    """Share of the intervals that contain the true value, over all conditions."""
    return {
        name: float(np.mean([t.covered[name] for repeats in trials for t in repeats]))
        for name in trials[0][0].covered
    }


def targets(worst: dict[str, float], rates: dict[str, float], trials: int) -> dict[str, Target]:
    """Targets; those of coverage allow for the statistics of this many trials."""
    within = SIGMAS * math.sqrt(PROBABILITY * (1.0 - PROBABILITY) / trials)
    errors = {f"worst {name} error": at_most(worst[name], most) for name, most in LIMITS.items()}
    return errors | {
        f"{name} coverage, distance from {PROBABILITY}": at_most(
            abs(rates[name] - PROBABILITY), within
        )
        for name in LIMITS
    }


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="5 seeds instead of 200")
    parser.add_argument("--seeds", type=int, default=200, help="records of each condition")
    options = parser.parse_args()
    reels = conditions()
    # Five seeds take less than the processes to start.
    seeds, jobs = (5, 1) if options.quick else (options.seeds, -1)
    trials = study(reels, excitation(), seeds, jobs)
    by_condition, rates = accuracy(reels, trials), coverage(trials)
    worst = {name: max(row[name] for row in by_condition.values()) for name in LIMITS}
    figures = {"worst_error": worst, "coverage": rates, "conditions": by_condition}
    reached = targets(worst, rates, sum(map(len, trials)))
    return print_results(figures, reached, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
