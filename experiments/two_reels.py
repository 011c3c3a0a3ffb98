"""Accuracy and limits of the two-reel procedure for the friction of the eyelets.

The procedure estimates the attenuation ratio B and the friction coefficient C_R on simulated
benches: over several geometries, with many seeds for the coverage of its interval, at a velocity,
with noise that hides the friction, and with unequal reels. Then the paper's figures: attenuation
ratio against tension setpoint (Fig. 7), hysteresis between two reels (Fig. 15), and the static
transparency (27) to (29) against Weber's limit.
"""

import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estune.errors import RigError
from experiments.results import Target, at_most, command_line, print_results, print_tables
from plants.two_reel_bench import (
    Eyelet,
    Gauge,
    HysteresisLoop,
    HysteresisTest,
    ReelModel,
    SimulatedBench,
    TwoReelProcedure,
    TwoReelResult,
    compare_reels,
    evaluate,
    eyelet_angle_rad,
)

SETPOINTS_N = (8.0, 16.0, 24.0, 32.0, 40.0)
SWEEPS = 12
SWEEPS_MAX = 60
PRELOAD_N = 2.0
GAUGE_Y = Gauge(zero=3.0, sensitivity=0.8, curvature_per_N=1e-3)
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


class Case(NamedTuple):
    """One bench."""

    eyelet: Eyelet
    other: Eyelet | None = None
    noise_N: float = 0.011
    wander_N: float = 0.01


def make_bench(case: Case, seed: int) -> SimulatedBench:
    """Two equal reels; Y's gauge has its own zero, sensitivity and curvature."""
    x = Gauge(noise_N=case.noise_N, drift_N=case.wander_N)
    y = replace(GAUGE_Y, noise_N=case.noise_N, drift_N=case.wander_N)
    return SimulatedBench(
        ReelModel(case.eyelet, x), ReelModel(case.other or case.eyelet, y), seed=seed
    )


def measure(case: Case, seed: int, **choices: Any) -> TwoReelResult:
    """One measurement of one bench."""
    usual = {"setpoints_N": SETPOINTS_N, "preload_N": PRELOAD_N, "sweeps": SWEEPS}
    procedure = TwoReelProcedure(**{**usual, **choices})
    other = case.other or case.eyelet
    return evaluate(
        procedure.run(make_bench(case, seed)),
        case.eyelet.angles_rad,
        other.angles_rad,
        tolerance=LIMIT,
        probability=PROBABILITY,
    )


def geometries(thin: int) -> dict[str, dict[str, Any]]:
    """Prints true and estimated C_R over geometries and coefficients."""
    print(f"friction coefficient over geometries, {SWEEPS} sweeps, more where needed\n")
    columns = f"{'interval, 95 %':>18s} {'error':>8s} {'sweeps':>7s}"
    print(f"  {'gamma deg':>9s} {'C_R':>6s} {'B':>7s} {'value':>8s} {columns}")
    rows = {}
    cases = list(product(enumerate(np.radians(GEOMETRIES_deg)), enumerate(COEFFICIENTS)))
    for (row, (outside, inside, turn)), (column, coefficient) in cases[::thin]:
        seed, gamma = 100 + 10 * row + column, eyelet_angle_rad(outside, 0.0, inside, turn)
        case = Case(Eyelet(coefficient, (gamma,)))
        result = measure(case, seed)
        if not result.resolved and SWEEPS < (result.sweeps_needed or 0) <= SWEEPS_MAX:
            result = measure(case, seed, sweeps=result.sweeps_needed)
        C = result.friction_coefficient
        sweeps, needed = result.ratios.shape[0], result.sweeps_needed
        note = "" if result.resolved else f"  not resolved, needs {needed} sweeps"
        print(
            f"  {math.degrees(gamma):9.1f} {coefficient:6.3f} "
            f"{case.eyelet.attenuation_at(0.0):7.4f} {C.value:8.5f} {C.low:8.5f} to {C.high:7.5f} "
            f"{100.0 * (C.value / coefficient - 1.0):6.2f} % {sweeps:6d}{note}"
        )
        rows[f"gamma {math.degrees(gamma):.1f} deg, C_R {coefficient:g}"] = {
            "true": coefficient,
            "value": C.value,
            "low": C.low,
            "high": C.high,
            "resolved": result.resolved,
            "sweeps": sweeps,
        }
    return rows


def _one(choices: dict[str, Any], case: Case, seed: int) -> tuple[float, bool, bool]:
    """Relative error of one measurement, whether it is covered, and whether it is resolved."""
    result = measure(case, seed, **choices)
    C, true = result.friction_coefficient, case.eyelet.coefficient
    return C.value / true - 1.0, C.low <= true <= C.high, result.resolved


def coverage(seeds: int, thin: int) -> dict[str, dict[str, float]]:
    """Prints the coverage of the intervals for each way of holding the other reel."""
    bend = f"gamma {math.degrees(STEEP):.1f} degrees"
    print(f"\ncoverage of the 95 % interval, {bend}\n")
    columns = ("seeds", "coverage", "rms error", "worst", "resolved", "worst of these")
    print(f"  {'':24s}" + "".join(f"{c:>15s}" for c in columns))
    rows = {}
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(mp_context=spawn) as pool:
        for name, holding, coefficient, benches in (
            ("breakout, C_R 0.1", "breakout", 0.1, seeds),
            ("breakout, C_R 0.05", "breakout", 0.05, seeds),
            ("position, C_R 0.1", "position", 0.1, seeds // thin),  # without a target
        ):
            task = partial(
                _one, {"holding": holding}, Case(replace(REFERENCE, coefficient=coefficient))
            )
            errors, held, resolved = map(
                np.array, zip(*pool.map(task, range(benches)), strict=True)
            )
            row = {
                "coverage": float(held.mean()),
                "rms_error": float(np.sqrt(np.mean(errors**2))),
                "worst_error": float(np.abs(errors).max()),
                "resolved": float(resolved.mean()),
                "worst_resolved_error": float(np.abs(errors[resolved]).max(initial=0.0)),
            }
            rows[name] = row
            cells = [f"{benches:15d}{row['coverage']:15.3f}"]
            cells += [f"{100.0 * row[k]:13.2f} %" for k in list(row)[1:]]
            print(f"  {name:24s}" + "".join(cells))
    return rows


def limits_of_the_bench() -> dict[str, dict[str, Any]]:
    """Prints the procedure's warnings on benches that do not determine the coefficient."""
    print("\nbenches that do not determine the coefficient\n")
    rows = {}
    for name, case in (
        ("gauge noise 0.011 N", Case(REFERENCE)),
        ("gauge noise 0.1 N", Case(REFERENCE, noise_N=0.1)),
        ("gauge drifts by 0.3 N", Case(REFERENCE, wander_N=0.3)),
        ("friction varies by 5 %", Case(replace(REFERENCE, variation=0.05))),
        ("almost straight, 5 degrees", Case(Eyelet(0.02, (math.radians(175.0),)))),
        ("folded, C_R 0.25", Case(Eyelet(0.25, (math.radians(90.0),)))),
    ):
        try:
            result = measure(case, seed=7)
            C = result.friction_coefficient
            off = abs(C.value / case.eyelet.coefficient - 1.0)
            row = {
                "resolved": result.resolved,
                "error": off,
                "said": "; ".join(result.warnings),
            }
        except RigError as error:
            row = {"resolved": False, "error": None, "said": str(error)}
        rows[name] = row
        print(f"  {name:28s} {'resolved' if row['resolved'] else 'not resolved'}")
        if row["said"]:
            print(f"      {row['said']}")
    return rows


def dynamic(thin: int) -> dict[str, dict[str, float]]:
    """Prints the dynamic coefficient at several velocities."""
    print("\ndynamic coefficient at a velocity of the cable\n")
    eyelet = replace(REFERENCE, dynamic_share=0.7, viscous_s_m=0.5)
    setpoints = (15.0, 20.0, 25.0, 32.0, 40.0)
    rows = {}
    for seed, velocity in list(enumerate((0.0, 0.005, 0.01, 0.02, 0.03), start=60))[::thin]:
        moving = {"holding": "moving", "velocity_m_s": velocity} if velocity else {}
        result = measure(Case(eyelet), seed, setpoints_N=setpoints, **moving)
        C, true = result.friction_coefficient, eyelet.coefficient_at(0.0, velocity)
        rows[f"{velocity:g} m/s"] = {"true": true, "value": C.value, "low": C.low, "high": C.high}
        print(f"  {velocity:5.3f} m/s  {C}, true {true:.5f}")
    return rows


def comparison(thin: int) -> dict[str, dict[str, Any]]:
    """Prints the comparison of equal and unequal reels by measurements with exchanged angles."""
    print("\nequality of the reels, from two measurements with exchanged angles\n")
    rows = {}
    a, b = math.radians(110.0), math.radians(145.0)
    for coefficient in (0.1, 0.11, 0.15)[::thin]:
        runs = [
            measure(Case(Eyelet(0.1, (x,)), Eyelet(coefficient, (y,))), seed)
            for seed, (x, y) in enumerate([(a, b), (b, a)], start=20)
        ]
        compared = compare_reels(*runs)
        rows[f"0.1 and {coefficient:g}"] = {
            "x": compared.coefficient_x.value,
            "y": compared.coefficient_y.value,
            "chance": compared.p_value,
            "alike": compared.alike,
        }
        print(
            f"  X 0.1, Y {coefficient:4g}: X {compared.coefficient_x}, Y "
            f"{compared.coefficient_y}, "
            f"{'alike' if compared.alike else 'not alike'} ({compared.p_value:.1g} by chance)"
        )
    return rows


def attenuation_figure() -> tuple[TwoReelResult, Eyelet, dict[str, Any]]:
    """Prints B against the tension setpoint, with friction that grows with tension (Fig. 7)."""
    eyelet = replace(REFERENCE, growth_per_N=4e-4)
    setpoints = tuple(np.linspace(8.0, 53.0, 10).tolist())
    result = measure(Case(eyelet), seed=31, setpoints_N=setpoints)
    print("\nattenuation ratio against tension setpoint (Fig. 7), friction growing with tension\n")
    print(f"  {'setpoint N':>10s} {'B':>8s} {'interval':>18s} {'true':>8s}")
    rows = []
    for setpoint, T, B in zip(
        result.setpoint_N, result.tension_N, result.ratio_at_setpoints(), strict=True
    ):
        true = eyelet.attenuation_at(float(T))
        rows.append(
            {"setpoint_N": setpoint, "B": B.value, "low": B.low, "high": B.high, "true": true}
        )
        print(f"  {setpoint:10.1f} {B.value:8.5f} {B.low:8.5f} to {B.high:7.5f} {true:8.5f}")
    for warning in result.warnings:
        print(f"  {warning}")
    return result, eyelet, {"rows": rows, "follows_coulomb": result.curve.follows_coulomb}


def transparency(thin: int) -> dict[str, dict[str, Any]]:
    """Prints the static transparency (27) to (29) of several reels."""
    print("\nstatic transparency, limit 0.1\n")
    rows = {}
    for name, eyelet in (
        ("10 degrees, C_R 0.1", Eyelet(0.1, (math.radians(170.0),))),
        ("65 degrees, C_R 0.1", REFERENCE),
        ("65 degrees, growing", replace(REFERENCE, growth_per_N=4e-4)),
        ("90 degrees, C_R 0.1", Eyelet(0.1, (math.radians(90.0),))),
    )[::thin]:
        index = measure(Case(eyelet), seed=41).transparency()
        rows[name] = {
            "log_mean": index.log_mean,
            "log_spread": index.log_spread,
            "friction_share": index.friction_share,
            "low": index.friction_share_low,
            "high": index.friction_share_high,
            "verdict": index.verdict,
        }
        print(
            f"  {name:22s} mean ln B {index.log_mean:8.4f}  spread {index.log_spread:8.5f}  "
            f"|F_R|/|T_2| {index.friction_share:6.4f} ({index.friction_share_low:6.4f} to "
            f"{index.friction_share_high:6.4f})  {index.verdict}"
        )
    return rows


def hysteresis(thin: int) -> tuple[dict[str, HysteresisLoop], dict[str, dict[str, float]]]:
    """Prints B from the hysteresis between the reels, beside the procedure's (Fig. 15)."""
    print("\nhysteresis between two reels (Fig. 15)\n")
    loops, rows = {}, {}
    for turn in (15.0, 45.0, 85.0)[::thin]:
        eyelet = Eyelet(0.1, (math.pi - math.radians(turn),))
        bench = make_bench(Case(eyelet), seed=51)
        procedure = TwoReelProcedure(SETPOINTS_N, preload_N=PRELOAD_N)
        result = evaluate(procedure.run(bench), eyelet.angles_rad)
        loop = HysteresisTest(6.0, 36.0, steps=24).run(bench, result.calibration_y(margin=0.5))
        true, by_loop = eyelet.attenuation_at(0.0), loop.attenuation()
        widest = float(np.ptp(loop.y[np.isclose(loop.x_N, 21.0, atol=0.6)]))
        name = f"cable turned by {turn:g} degrees"
        loops[name] = loop
        rows[name] = {
            "true": true,
            "loop": by_loop,
            "procedure": result.attenuation.value,
            "width_N": widest,
        }
        print(
            f"  {name:32s} width at 21 N {widest:6.2f} N, B {by_loop:.4f} by the loop, "
            f"{result.attenuation.value:.4f} by the procedure, true {true:.4f}"
        )
    return loops, rows


def save_figure(
    result: TwoReelResult, eyelet: Eyelet, loops: dict[str, HysteresisLoop], path: Path
) -> None:
    """Fig. 7 with the true curve, and Fig. 15."""
    import matplotlib as mpl  # noqa: PLC0415  slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    figure, (ratio, loop_axes) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    ratios = result.ratio_at_setpoints()
    B, half = (
        np.array(column)
        for column in zip(*((b.value, b.high - b.value) for b in ratios), strict=True)
    )
    ratio.plot(result.setpoint_N, result.ratios.T, ".", color="0.7", markersize=3)
    ratio.errorbar(result.setpoint_N, B, half, fmt="o", capsize=3, label="measured, 95 %")
    true = [eyelet.attenuation_at(float(T)) for T in result.tension_N]
    ratio.plot(result.setpoint_N, true, "k--", linewidth=1.0, label="true")
    ratio.axhline(0.9, color="C3", linewidth=1.0, label="Weber's limit")
    ratio.set(xlabel="tension setpoint, N", ylabel="attenuation ratio B")
    ratio.legend()
    for name, loop in loops.items():
        loop_axes.plot(loop.x_N, loop.y, ".-", linewidth=0.8, markersize=3, label=name)
    loop_axes.set(xlabel="tension at X, N", ylabel="tension at Y, N")
    loop_axes.legend()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


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
    image = Path("out") / "two_reels.png"
    with print_tables(hidden=options.json):
        table, rates, cannot = geometries(thin), coverage(seeds, thin), limits_of_the_bench()
        figures: dict[str, Any] = {
            "geometries": table,
            "coverage": rates,
            "cannot_tell": cannot,
            "dynamic": dynamic(thin),
            "likeness": comparison(thin),
            "transparency": transparency(thin),
        }
        result, eyelet, figures["attenuation_against_setpoint"] = attenuation_figure()
        loops, figures["hysteresis"] = hysteresis(thin)
        save_figure(result, eyelet, loops, image)
        print(f"figure: {image}")
    return print_results(figures, targets(table, rates, cannot, seeds), as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
