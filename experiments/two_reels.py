"""Accuracy and limits of the two-reel procedure for the friction of the eyelets.

The procedure estimates the friction coefficient C_R on simulated benches: over several geometries,
with many seeds for the coverage of its interval, and where noise or geometry hides the friction.
`python -m experiments.paper` has the attenuation ratio against the setpoint and the hysteresis.
"""

import math
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed

from estune.errors import RigError
from experiments.results import Target, at_most, command_line, print_results
from plants.bench.two_reels import (
    BenchGauge,
    Eyelet,
    ReelModel,
    SimulatedBench,
    TwoReelProcedure,
    TwoReelResult,
    evaluate,
    eyelet_angle_rad,
)

SETPOINTS_N = (8.0, 16.0, 24.0, 32.0, 40.0)
SWEEPS = 12
SWEEPS_MAX = 60
PRELOAD_N = 2.0
GAUGE_Y = BenchGauge(zero=3.0, sensitivity=0.8, curvature_per_N=1e-3)
LIMIT = 0.02
PROBABILITY = 0.95
SIGMAS = 3.29
"""Standard deviations exceeded once in a thousand times."""

# Angle of the cable to the eyelet's axis outside and inside, and from one projection to the other.
GEOMETRIES_deg = ((10.0, 0.0, 0.0), (20.0, 10.0, 60.0), (30.0, 0.0, 0.0), (45.0, 20.0, 90.0))
COEFFICIENTS = (0.05, 0.1, 0.15)
THIN = 4
"""With --quick every fourth row of a table, each with another geometry and coefficient."""
STEEP = eyelet_angle_rad(math.radians(45.0), 0.0, math.radians(20.0), 0.0)
"""Bend of the reference bench: 45 degrees outside and 20 inside, in one plane."""

REFERENCE = Eyelet(0.1, (STEEP,))


class TwoReelCase(NamedTuple):
    """One bench."""

    eyelet: Eyelet
    noise_N: float = 0.011
    wander_N: float = 0.01


def make_bench(case: TwoReelCase, seed: int) -> SimulatedBench:
    """Two equal reels; Y's gauge has its own zero, sensitivity and curvature."""
    x = BenchGauge(noise_N=case.noise_N, drift_N=case.wander_N)
    y = replace(GAUGE_Y, noise_N=case.noise_N, drift_N=case.wander_N)
    return SimulatedBench(ReelModel(case.eyelet, x), ReelModel(case.eyelet, y), seed=seed)


def measure(case: TwoReelCase, seed: int, **choices: Any) -> TwoReelResult:
    """One measurement of one bench."""
    procedure = TwoReelProcedure(
        **{"setpoints_N": SETPOINTS_N, "preload_N": PRELOAD_N, "sweeps": SWEEPS, **choices}
    )
    return evaluate(
        procedure.run(make_bench(case, seed)),
        case.eyelet.angles_rad,
        tolerance=LIMIT,
        probability=PROBABILITY,
    )


def geometries(thin: int) -> dict[str, dict[str, Any]]:
    """True and estimated C_R over geometries and coefficients."""
    rows = {}
    cases = list(product(enumerate(np.radians(GEOMETRIES_deg)), enumerate(COEFFICIENTS)))
    for (row, (outside, inside, turn)), (column, coefficient) in cases[::thin]:
        seed, gamma = 100 + 10 * row + column, eyelet_angle_rad(outside, 0.0, inside, turn)
        case = TwoReelCase(Eyelet(coefficient, (gamma,)))
        result = measure(case, seed)
        if not result.resolved and SWEEPS < (result.sweeps_needed or 0) <= SWEEPS_MAX:
            result = measure(case, seed, sweeps=result.sweeps_needed)
        C = result.friction_coefficient
        rows[f"gamma {math.degrees(gamma):.1f} deg, C_R {coefficient:g}"] = {
            "true": coefficient,
            "value": C.value,
            "low": C.low,
            "high": C.high,
            "resolved": result.resolved,
            "sweeps": result.ratios.shape[0],
        }
    return rows


def _one(holding: str, case: TwoReelCase, seed: int) -> tuple[float, bool, bool]:
    """Relative error of one measurement, whether it is covered, and whether it is resolved."""
    result = measure(case, seed, holding=holding)
    C, true = result.friction_coefficient, case.eyelet.coefficient
    return C.value / true - 1.0, C.low <= true <= C.high, result.resolved


def coverage(seeds: int, thin: int) -> dict[str, dict[str, float]]:
    """Coverage of the intervals for each way of holding the other reel."""
    rows = {}
    for name, holding, coefficient, benches in (
        ("breakout, C_R 0.1", "breakout", 0.1, seeds),
        ("breakout, C_R 0.05", "breakout", 0.05, seeds),
        ("position, C_R 0.1", "position", 0.1, seeds // thin),  # without a target
    ):
        case, measured = TwoReelCase(replace(REFERENCE, coefficient=coefficient)), delayed(_one)
        made = Parallel(n_jobs=-1)(measured(holding, case, seed) for seed in range(benches))
        errors, held, resolved = map(np.array, zip(*made, strict=True))
        rows[name] = {
            "coverage": float(held.mean()),
            "rms_error": float(np.sqrt(np.mean(errors**2))),
            "worst_error": float(np.abs(errors).max()),
            "resolved": float(resolved.mean()),
            "worst_resolved_error": float(np.abs(errors[resolved]).max(initial=0.0)),
        }
    return rows


def limits_of_the_bench() -> dict[str, dict[str, Any]]:
    """Warnings of the procedure on benches that do not determine the coefficient."""
    rows: dict[str, dict[str, Any]] = {}
    for name, case in (
        ("gauge noise 0.011 N", TwoReelCase(REFERENCE)),
        ("gauge noise 0.1 N", TwoReelCase(REFERENCE, noise_N=0.1)),
        ("gauge drifts by 0.3 N", TwoReelCase(REFERENCE, wander_N=0.3)),
        ("friction varies by 5 %", TwoReelCase(replace(REFERENCE, variation=0.05))),
        ("almost straight, 5 degrees", TwoReelCase(Eyelet(0.02, (math.radians(175.0),)))),
        ("folded, C_R 0.25", TwoReelCase(Eyelet(0.25, (math.radians(90.0),)))),
    ):
        try:
            result = measure(case, seed=7)
        except RigError as error:
            rows[name] = {"resolved": False, "error": None, "said": str(error)}
            continue
        C = result.friction_coefficient
        rows[name] = {
            "resolved": result.resolved,
            "error": abs(C.value / case.eyelet.coefficient - 1.0),
            "said": "; ".join(result.warnings),
        }
    return rows


def targets(
    table: dict[str, dict[str, Any]],
    rates: dict[str, dict[str, float]],
    cannot: dict[str, dict[str, Any]],
    seeds: int,
) -> dict[str, Target]:
    """Targets; those of coverage allow for the statistics of this many seeds."""
    errors = [abs(row["value"] / row["true"] - 1.0) for row in table.values() if row["resolved"]]
    errors += [row["worst_resolved_error"] for row in rates.values()]
    without_warning = [
        name
        for name, row in cannot.items()
        if (row["error"] > LIMIT if row["resolved"] else not row["said"])
    ]
    within = SIGMAS * math.sqrt(PROBABILITY * (1.0 - PROBABILITY) / seeds)
    result = {
        "worst C_R error of a resolved measurement": at_most(max(errors), LIMIT),
        "benches that cannot tell and do not say so": at_most(len(without_warning), 0),
    }
    for name in ("breakout, C_R 0.1", "breakout, C_R 0.05"):
        off = abs(rates[name]["coverage"] - PROBABILITY)
        result[f"coverage, {name}, distance from {PROBABILITY}"] = at_most(off, within)
    return result


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="8 seeds instead of 200, and a quarter of the tables")
    parser.add_argument("--seeds", type=int, default=200, help="benches for the coverage")
    options = parser.parse_args()
    seeds, thin = (8, THIN) if options.quick else (options.seeds, 1)
    table, rates, cannot = geometries(thin), coverage(seeds, thin), limits_of_the_bench()
    figures = {"geometries": table, "coverage": rates, "cannot_tell": cannot}
    reached = targets(table, rates, cannot, seeds)
    return print_results(figures, reached, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
