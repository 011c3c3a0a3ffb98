"""Accuracy of a reel's identification from ten seconds of noisy data, and interval coverage.

The reference reel is excited in open loop about its preload by a multisine of ten seconds, two of
them to settle, at four lengths and four tensions, each with many seeds. Estimates are compared
with the reel's parameters. Further tables: other excitations, interpolation between the
conditions, distortion by friction, and the initial gains of each rule.
"""

import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.initial import proposals
from estune.core.metrics import step_metrics
from experiments.results import Target, at_most, command_line, print_results, print_tables
from plants.effects import CoulombFriction
from plants.identify import (
    Band,
    Condition,
    Dependence,
    Excitation,
    SecondOrderFit,
    chirp,
    fit_second_order,
    multisine,
    open_loop_record,
    response_of_record,
    stepped_sine,
)
from plants.models.reel import Reel, reference_reel
from plants.models.reel_equations import drum_stiffness_Nm_rad, viscous_friction_Nms
from plants.simulation.batch import simulate

LENGTHS_m = (0.5, 0.8, 1.1, 1.4)
TENSIONS_N = (5.0, 10.0, 20.0, 40.0)
SAMPLING_HZ = 632.0
BAND = Band(low_Hz=0.5, high_Hz=310.0, period_s=2.0, periods=4, settling_periods=1)
PEAK_N = 40.0
PROBABILITY = 0.95
LIMITS = {"resonance": 0.005, "damping": 0.05, "dead_time": 0.1}
UNITS = {"resonance": ("%", 100.0), "damping": ("%", 100.0), "dead_time": ("samples", 1.0)}
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


def excitation() -> Excitation:
    """The multisine of the experiment, with most power above the resonance."""
    return multisine(SAMPLING_HZ, BAND, PEAK_N, slope=1.5, corner_Hz=20.0)


def conditions() -> list[Reel]:
    """Four lengths by four tensions, and a reel with a fractional dead time."""
    grid = [reference_reel(L, T) for L in LENGTHS_m for T in TENSIONS_N]
    return [*grid, reference_reel(0.8, 15.0, dead_time_s=1.37 / SAMPLING_HZ)]


def truth(reel: Reel) -> dict[str, float]:
    """True parameters of the reel, in the units of the estimates."""
    w = reel.natural_frequency_rad_s
    zeta = viscous_friction_Nms(reel) / (2.0 * reel.drum_inertia_kg_m2 * w)
    return {
        "resonance": w * math.sqrt(1.0 - 2.0 * zeta**2) / (2.0 * math.pi),
        "damping": zeta,
        "dead_time": reel.dead_time_s,
        "gain": reel.newtons_per_ampere,
        "gauge_frequency": reel.gauge_Hz,
        "gauge_damping": reel.gauge_damping,
    }


def identify(reel: Reel, signal: Excitation, seed: int) -> SecondOrderFit:
    """Fit of one record."""
    record = open_loop_record(reel, signal, seed)
    return fit_second_order(response_of_record(record, signal), probability=PROBABILITY)


def compare(reel: Reel, fit: SecondOrderFit) -> Trial:
    """Comparison of a fit with the true parameters."""
    estimates = {
        "resonance": fit.resonance_Hz,
        "damping": fit.damping,
        "dead_time": fit.dead_time_s,
        "gain": fit.gain,
        "gauge_frequency": fit.gauge_Hz,
        "gauge_damping": fit.gauge_damping,
    }
    error, covered, half_width = {}, {}, {}
    for name, true in truth(reel).items():
        estimate = estimates[name]
        if estimate is None:
            continue
        unit = 1.0 / SAMPLING_HZ if name == "dead_time" else true
        error[name] = (estimate.value - true) / unit
        covered[name] = estimate.low <= true <= estimate.high
        half_width[name] = (estimate.high - estimate.low) / (2.0 * unit)
    return Trial(error, covered, half_width)


def repeat(reel: Reel, signal: Excitation, seeds: range) -> list[Trial]:
    """Trials of one condition with many seeds."""
    return [compare(reel, identify(reel, signal, seed)) for seed in seeds]


def study(reels: list[Reel], signal: Excitation, seeds: int) -> list[list[Trial]]:
    """Trials of all conditions, each with its own seeds, on all cores."""
    ranges = [range(seeds * n, seeds * (n + 1)) for n in range(len(reels))]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(mp_context=spawn) as pool:
        return list(pool.map(partial(_repeat, signal), reels, ranges))


def _repeat(signal: Excitation, reel: Reel, seeds: range) -> list[Trial]:
    return repeat(reel, signal, seeds)


def accuracy(reels: list[Reel], trials: list[list[Trial]]) -> dict[str, float]:
    """Prints the worst error of each condition; returns the worst overall."""
    print(f"worst error over {len(trials[0])} seeds (half width of the 95 % interval, typical)\n")
    print("  L m  T N  dead time   " + "".join(f"{name:>26s}" for name in LIMITS))
    worst = dict.fromkeys(LIMITS, 0.0)
    for reel, repeats in zip(reels, trials, strict=True):
        cells = []
        for name in LIMITS:
            unit, factor = UNITS[name]
            error = max(abs(trial.error[name]) for trial in repeats)
            half = float(np.median([trial.half_width[name] for trial in repeats]))
            worst[name] = max(worst[name], error)
            cells.append(f"{error * factor:9.4f} ({half * factor:7.4f}) {unit:7s}")
        place = f"  {reel.cable_length_m:3.1f} {reel.tension_N:4.0f}"
        print(f"{place} {reel.dead_time_s * SAMPLING_HZ:8.2f} h  " + "".join(cells))
    return worst


def coverage(trials: list[list[Trial]]) -> dict[str, float]:
    """Prints the coverage of the intervals; returns the pooled rates."""
    print(f"\ncoverage of the 95 % intervals, {len(trials)} conditions x {len(trials[0])} seeds\n")
    print(f"  {'':16s} {'pooled':>8s} {'least':>8s} {'most':>8s}   of one condition")
    pooled = {}
    for name in trials[0][0].covered:
        rates = [float(np.mean([t.covered[name] for t in repeats])) for repeats in trials]
        pooled[name] = float(np.mean(rates))
        print(f"  {name:16s} {pooled[name]:8.3f} {min(rates):8.3f} {max(rates):8.3f}")
    return pooled


def other_excitations(reel: Reel) -> dict[str, dict[str, float]]:
    """Prints the errors with chirp and stepped sine beside those with the multisine."""
    print(f"\nother excitations, {reel.cable_length_m:g} m, {reel.tension_N:g} N, one record\n")
    columns = ("resonance %", "damping %", "dead time h")
    print(f"  {'':14s} {'record s':>9s} {'crest':>6s} " + "".join(f"{c:>13s}" for c in columns))
    one_by_one = Band(1.0, 310.0, period_s=1.0, periods=2, settling_periods=2)
    rows = {}
    for name, signal in (
        ("multisine", excitation()),
        # Resonance and preload limit the amplitude of these, which cannot be shaped.
        ("chirp", chirp(SAMPLING_HZ, BAND, 15.0)),
        ("stepped sine", stepped_sine(SAMPLING_HZ, one_by_one, 2.5, points=30)),
    ):
        error = compare(reel, identify(reel, signal, seed=1)).error
        rows[name] = {
            "record_s": signal.duration_s,
            "crest_factor": signal.crest_factor,
            **{f"{quantity}_error": error[quantity] for quantity in LIMITS},
        }
        print(
            f"  {name:14s} {signal.duration_s:9.1f} {signal.crest_factor:6.2f} "
            f"{100.0 * error['resonance']:13.4f}{100.0 * error['damping']:13.3f}"
            f"{error['dead_time']:13.4f}"
        )
    return rows


def between(signal: Excitation) -> dict[str, float]:
    """Prints the worst interpolation error between the conditions."""
    grid = [(L, T) for L in LENGTHS_m for T in TENSIONS_N]
    dependence = Dependence(
        [
            Condition(L, T, identify(reference_reel(L, T), signal, n))
            for n, (L, T) in enumerate(grid)
        ]
    )
    worst = {"resonance": 0.0, "damping": 0.0}
    for L in np.linspace(LENGTHS_m[0], LENGTHS_m[-1], 13):
        for T in np.geomspace(TENSIONS_N[0], TENSIONS_N[-1], 13):
            true, model = truth(reference_reel(float(L), float(T))), dependence.at(L, T)
            estimates = {
                "resonance": model.resonance_rad_s / (2.0 * math.pi),
                "damping": model.damping,
            }
            for name, value in estimates.items():
                worst[name] = max(worst[name], abs(value / true[name] - 1.0))
    print("\nthe interpolating model at 13 x 13 lengths and tensions, worst error")
    print(f"  resonance {100 * worst['resonance']:.3f} %, damping {100 * worst['damping']:.3f} %")
    return worst


def friction(signal: Excitation) -> dict[str, dict[str, float]]:
    """Prints the distortion on unexcited lines by dry friction."""
    print("\ndistortion on unexcited lines, relative to the excited ones\n")
    print(f"  {'':30s} {'odd':>9s} {'chance':>8s} {'even':>9s} {'chance':>8s} {'misfit':>8s}")
    rows = {}
    for torque in (0.0, 0.01, 0.05):
        reel = reference_reel(0.8, 20.0)
        if torque:
            reel = reel + CoulombFriction(torque_Nm=torque)
        answer = response_of_record(open_loop_record(reel, signal, seed=1), signal)
        misfit = fit_second_order(answer).misfit
        if answer.odd is None or answer.even is None:
            continue
        name = f"Coulomb friction {torque:g} N m"
        rows[name] = {"odd": answer.odd.share, "even": answer.even.share, "misfit": misfit}
        print(
            f"  {name:30s} {answer.odd.share:9.4f} {answer.odd.p_value:8.1g} "
            f"{answer.even.share:9.4f} {answer.even.p_value:8.1g} {misfit:8.2f}"
        )
    return rows


def stiffness(signal: Excitation) -> dict[str, dict[str, float]]:
    """Prints the Hooke constant by (30) at four lengths, beside the true one."""
    print("\nHooke constant k_m (30) at 15 N for the known inertia, N m/rad\n")
    rows = {}
    for n, length in enumerate(LENGTHS_m):
        reel = reference_reel(length, 15.0)
        k = identify(reel, signal, n).hooke_constant_Nm_rad(reel.drum_inertia_kg_m2)
        true = drum_stiffness_Nm_rad(reel, reel.tension_N)
        rows[f"{length:g} m"] = {"value": k.value, "low": k.low, "high": k.high, "true": true}
        print(f"  {length:g} m  {k}, true {true:.5g}")
    return rows


def initial(signal: Excitation) -> dict[str, dict[str, dict[str, float | None]]]:
    """Prints the gains of each rule from the identified model, and their step response."""
    print("\ninitial gains from the identified model at 15 N, and a step of 10 N with them\n")
    print(
        f"  {'L m':>4s} {'rule':20s} {'P':>7s} {'I 1/s':>8s} {'D s':>8s} {'gain m.':>8s} "
        f"{'phase m.':>9s} {'settles s':>10s} {'overshoot':>10s}"
    )
    tables_by_length: dict[str, dict[str, dict[str, float | None]]] = {}
    for n, length in enumerate(LENGTHS_m):
        reel = reference_reel(length, 15.0)
        model = identify(reel, signal, n).model.per_effort(reel.newtons_per_ampere)
        rows = tables_by_length[f"{length:g} m"] = {}
        for rule, gains, margins in proposals(model, reel.controller):
            response, step = simulate(reel, gains), reel.profile
            metrics = step_metrics(
                response.time_s,
                response.tension_N,
                step_time_s=step.step_at_s,
                initial=step.preload_N,
                final=step.preload_N + step.step_N,
            )
            row = {
                **dict(zip(("P", "I", "D"), gains.as_tuple(), strict=False)),
                "gain_margin": margins.gain_margin,
                "phase_margin_deg": margins.phase_margin_deg,
                "settling_s": metrics.settling_time_s,
                "overshoot": metrics.overshoot,
            }
            rows[rule] = {key: v if math.isfinite(v) else None for key, v in row.items()}
            print(
                f"  {length:4.1f} {rule:20s} {gains.P:7.3f} {gains.I:8.2f} {gains.D:8.4f} "
                f"{margins.gain_margin:8.2f} {margins.phase_margin_deg:9.1f} "
                f"{metrics.settling_time_s:10.3f} {metrics.overshoot:10.3f}"
            )
    return tables_by_length


def save_figure(signal: Excitation, path: Path) -> None:
    """Measured responses with confidence bands and fitted models, at four lengths and 15 N."""
    import matplotlib as mpl  # noqa: PLC0415  slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    figure, (size, phase) = plt.subplots(2, 1, sharex=True, figsize=(7, 6), layout="constrained")
    for n, length in enumerate(LENGTHS_m):
        reel = reference_reel(length, 15.0)
        answer = response_of_record(open_loop_record(reel, signal, seed=n), signal)
        fit, f, scale = fit_second_order(answer), answer.frequency_Hz, reel.newtons_per_ampere
        colour = f"C{n}"
        low, high = answer.magnitude_band(PROBABILITY)
        size.fill_between(f, low / scale, high / scale, color=colour, alpha=0.3, linewidth=0.0)
        dense = np.geomspace(f[0], f[-1], 1000)
        modelled = fit.model.sampled_response(dense, SAMPLING_HZ)
        size.loglog(dense, np.abs(modelled) / scale, color=colour, label=f"{length:g} m")
        early, late = answer.phase_band_deg(PROBABILITY)
        phase.fill_between(f, early, late, color=colour, alpha=0.3, linewidth=0.0)
        phase.semilogx(dense, np.degrees(np.unwrap(np.angle(modelled))), color=colour)
    size.set(ylabel="tension per command, N/N", title="bands: measured, 95 %; lines: fitted")
    size.legend()
    phase.set(xlabel="frequency, Hz", ylabel="phase, degrees")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


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
    parser = command_line(__doc__, quick="15 seeds instead of 200")
    parser.add_argument("--seeds", type=int, default=200, help="records of each condition")
    options = parser.parse_args()
    signal, reels = excitation(), conditions()
    image = Path("out") / "identification.png"
    with print_tables(hidden=options.json):
        print(
            f"multisine of {signal.duration_s:g} s, {len(signal.segments[0].excited)} lines from "
            f"{BAND.low_Hz:g} to {BAND.high_Hz:g} Hz, crest factor {signal.crest_factor:.2f}, "
            f"{BAND.periods} periods of {BAND.period_s:g} s after {BAND.settling_periods} to "
            "settle; gauge noise 0.04 N rms"
        )
        trials = study(reels, signal, 15 if options.quick else options.seeds)
        worst, rates = accuracy(reels, trials), coverage(trials)
        figures = {
            "worst_error": worst,
            "coverage": rates,
            "excitations": other_excitations(reference_reel(0.8, 20.0)),
            "between_conditions": between(signal),
            "distortion": friction(signal),
            "hooke_constant_Nm_rad": stiffness(signal),
            "initial_gains": initial(signal),
        }
        save_figure(signal, image)
        print(f"figure: {image}")
    reached = targets(worst, rates, sum(map(len, trials)))
    return print_results(figures, reached, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
