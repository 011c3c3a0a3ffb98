"""Are measured logs of a heated chamber replayed, used, judged and predicted?

Command: `python -m experiments.oven --data FOLDER`.
Target: effort replayed to 0.05 % of the output's range or other gains named, the run left out
predicted to 0.8 % of its range and 25 mK about steps, Ms of single runs within 15 % of the pooled
one or not stated, 3 s of CPU time a record of 10 000 samples and 10 s for all.

Eleven runs of a small chamber under an Arduino PID (`oven` of cellularmitosis/logs, 2018), whose
names state the gains. The controller sees the reading of a thermistor, which falls with the
temperature; its output goes from 0 to 255, without its fraction. A model of all runs but one
predicts the one left out in closed loop, from its first seconds and its setpoint alone: of the
temperature, by output errors (`plant_of`). The data are not part of this project: `--data` or the
environment variable ESTUNE_DATA is the folder with oven/run02_kp2.0_ki1.0_kd0.5.csv and further
runs.
"""

import math
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import signals_of
from estune.loop_model.identification import PoleFit, searched_dead_time
from estune.loop_model.loop_fit import model_of
from estune.loop_model.margins import robustness
from estune.loop_model.model import LoopModel, exchanged
from estune.loop_model.poles import polynomial
from estune.recordings.loop_log import LoopLog
from estune.service_records.identification import ServicePart, identify
from estune.service_records.replay import replay
from estune.service_records.sources import Logs
from estune.service_records.stretches import find_stretches, whole_stretches
from estune.service_records.suggestion import suggest
from experiments.measured_data import folder
from experiments.results import Target, at_least, at_most, command_line, print_results

SAMPLING_Hz, OUTPUT_MAX, LIBRARY_s = 4.0, 255.0, 0.1
"""Rate of the rows, largest output, and the sample time by which the library scales I and D."""

SETTINGS = ControllerSettings(
    SAMPLING_Hz, 0.0, -math.inf, math.inf, ControllerForm(integral="backward")
)

BEGUN_s, STEP_s = 5.0, 20.0
"""Beginning of a run that its prediction may use, and time after a step that is judged alone."""

REPLAYED, PREDICTED, ABOUT_STEPS_K, POOLED = 0.0005, 0.008, 0.025, 0.15
RECORD_s, FOLDER_s = 3.0, 10.0
"""Targets."""


class ChamberRun(NamedTuple):
    """A run of the chamber.

    Attributes:
        log: Its signals as the controller sees them, with the gains of its name.
        parts: Its usable stretches, with the gains that the effort shows.
        sentence: What the replay of the effort says.
        replayed: What those gains leave of the effort, over the output's range.
    """

    log: LoopLog
    parts: tuple[ServicePart, ...]
    sentence: str
    replayed: float

    @property
    def gains(self) -> Gains:
        """The gains that ran."""
        return self.parts[0].gains

    @property
    def samples(self) -> int:
        """Number of samples, those at a limit among them."""
        return self.log.parts[0]["time"].size


def reading(temperature_degC: FloatArray | float) -> FloatArray:
    """Reading of the converter, negated so that it rises with the temperature."""
    inverse = 1.0 / (temperature_degC + 273.15) - 1.0 / 294.15
    ohms = 11800.0 * np.exp(3977.0 * inverse)
    return np.asarray(-1023.0 * ohms / (9853.0 + ohms))


def temperature_degC(reading: FloatArray) -> FloatArray:
    """Temperature of a negated reading."""
    ohms = -9853.0 * reading / (1023.0 + reading)
    return np.asarray(1.0 / (np.log(ohms / 11800.0) / 3977.0 + 1.0 / 294.15) - 273.15)


def read_run(file: Path) -> ChamberRun:
    """A run, its effort replayed."""
    time_s, setpoint, measured, effort = np.loadtxt(file, delimiter=",", skiprows=1, unpack=True)
    stated = re.findall(r"k[pid]([\d.]+\d)", file.stem)
    kp, ki, kd = (float(number) for number in stated)
    rows = LIBRARY_s * SAMPLING_Hz
    gains = Gains(kp, rows * ki, kd / rows, 0.0)
    columns = {
        "time": time_s,
        "setpoint": reading(setpoint),
        "measurement": reading(measured),
        "effort": effort,
    }
    log = LoopLog(file.stem, SAMPLING_Hz, (columns,), gains, {}, {}, ())
    stretches = find_stretches(log, gains.P)[0]
    found = replay(stretches, SETTINGS, gains)
    ran = gains if found.agrees or found.ran is None else found.ran
    error = min(found.stated_error, found.ran_error) * found.range / OUTPUT_MAX
    parts = tuple(ServicePart(stretch, ran) for stretch in stretches)
    return ChamberRun(log, parts, found.sentence(), error)


def temperature_parts(run: ChamberRun) -> Iterator[ServicePart]:
    """Stretches of a run with the temperature as measurement, and gains of its mean slope."""
    (columns,), gains = run.log.parts, run.gains
    names = "setpoint", "measurement"
    in_degC = {**columns, **{name: temperature_degC(columns[name]) for name in names}}
    slope = float(np.ptp(columns["measurement"]) / np.ptp(in_degC["measurement"]))
    ran = replace(gains, P=slope * gains.P, I=slope * gains.I, D=slope * gains.D)
    for stretch in whole_stretches(run.log._replace(parts=(in_degC,)))[0]:
        yield ServicePart(stretch, ran)


def plant_of(runs: Sequence[ChamberRun]) -> LoopModel:
    """The plant of runs from output to temperature, by output errors.

    From the poles that `identify` finds. By its own fit, which takes the errors within a step of
    the converter for a drift, runs that are left out are predicted to 0.3 to 1.9 % of their range,
    by output errors to 0.3 to 0.8 %; of readings, which a linear plant does not make, to 2.0 %.
    """
    loop = identify([part for run in runs for part in temperature_parts(run)], SETTINGS, None)
    model, samples = loop.fit.model, loop.fit.settling_samples
    signals = signals_of(loop.records, samples)
    start = PoleFit(0.0, np.array(model.coordinates), model.dead_samples)
    found = searched_dead_time(signals, [start])
    return model_of(found.solution(signals))


def begun(model: LoopModel, run: ChamberRun, ambient_degC: float) -> FloatArray:
    """Temperature by a model over the first seconds of a run, above ambient, (samples,).

    The output was off before a run: its slowest pole is in motion, others about as little as a
    step of the converter hides. All free, the steps of 0.09 K put them up to 0.25 K off.

    Args:
        model: Of the plant, from output to temperature.
        run: The run; its output acts without its fraction.
        ambient_degC: Temperature without any output.
    """
    columns, (A, B), samples = run.log.parts[0], polynomials(model), round(BEGUN_s * SAMPLING_Hz)
    driven = lfilter(B, A, np.floor(columns["effort"][:samples]))
    poles = np.array(sorted(np.roots(A), key=abs, reverse=True))
    waves = poles[:, np.newaxis] ** np.arange(samples)
    free = np.where(poles.imag[:, np.newaxis] < 0.0, waves.imag, waves.real)
    rests = np.diag([0.0, *np.ones(poles.size - 1)])
    measured = temperature_degC(columns["measurement"][:samples])
    wanted = np.concatenate([measured - ambient_degC - driven, np.zeros(poles.size)])
    start = np.linalg.lstsq(np.concatenate([free, rests], axis=1).T, wanted, rcond=None)[0]
    return np.asarray(driven + start @ free)


def ambient_of(model: LoopModel, runs: Sequence[ChamberRun]) -> float:
    """Temperature without any output by which a model predicts runs best in closed loop, degC.

    In open loop a gain that is 10 % off moves it by 0.7 K, which a controller without integral
    shows as an offset.
    """
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    first = [float(temperature_degC(run.log.parts[0]["measurement"][0])) for run in runs]
    start = float(np.mean(first))

    def total(ambient_degC: float) -> float:
        return sum(_error(model, run, ambient_degC) ** 2 for run in runs)

    found = minimize_scalar(total, bracket=(start - 1.0, start + 1.0), options={"xtol": 5e-4})
    return float(found.x)


def polynomials(model: LoopModel) -> tuple[FloatArray, FloatArray]:
    """A and q^-(d+1) B in powers of q^-1."""
    zeros = exchanged(np.array(model.numerator))
    return polynomial(model.coordinates), np.pad(zeros, (model.dead_samples + 1, 0))


def predicted_degC(model: LoopModel, run: ChamberRun, ambient_degC: float) -> FloatArray:
    """Temperature of a run by a model, in closed loop from its first seconds on, (samples,).

    Args:
        model: Of the plant, from output to temperature.
        run: The run.
        ambient_degC: Temperature without any output.
    """
    columns, gains, h = run.log.parts[0], run.gains, 1.0 / SAMPLING_Hz
    setpoint, start = columns["setpoint"], begun(model, run, ambient_degC)
    (A, B), rows = polynomials(model), start.size
    effort, rise = np.floor(columns["effort"]), np.zeros(setpoint.size)
    rise[:rows] = start
    before = columns["measurement"][rows - 1]
    sums = 0.0
    if gains.I:
        sums = columns["effort"][rows - 1] - gains.P * (setpoint[rows - 1] - before)
        sums += gains.D / h * (before - columns["measurement"][rows - 2])
    before = float(reading(ambient_degC + rise[rows - 1]))
    for k in range(rows, setpoint.size):
        rise[k] = B[1:] @ effort[k - 1 : k - B.size : -1] - A[1:] @ rise[k - 1 : k - A.size : -1]
        seen = float(reading(ambient_degC + rise[k]))
        error = setpoint[k] - seen
        sums = min(max(sums + gains.I * h * error, 0.0), OUTPUT_MAX)
        asked = gains.P * error + sums - gains.D / h * (seen - before)
        effort[k], before = math.floor(min(max(asked, 0.0), OUTPUT_MAX)), seen
    return ambient_degC + rise


def prediction(
    model: LoopModel, others: Sequence[ChamberRun], run: ChamberRun
) -> tuple[float, float]:
    """Error of a predicted run over its range, and the largest about a step, K."""
    ambient_degC, columns = ambient_of(model, others), run.log.parts[0]
    error = predicted_degC(model, run, ambient_degC) - temperature_degC(columns["measurement"])
    steps = np.flatnonzero(np.diff(columns["setpoint"]) > 0.0) + 1
    after = [error[k : k + round(STEP_s * SAMPLING_Hz)] for k in steps]
    return _error(model, run, ambient_degC), max(_rms(one) for one in after)


def _error(model: LoopModel, run: ChamberRun, ambient_degC: float) -> float:
    """Root mean square of the error of a predicted run, over its range."""
    measured = temperature_degC(run.log.parts[0]["measurement"])
    return _rms(predicted_degC(model, run, ambient_degC) - measured) / float(np.ptp(measured))


def left_out(runs: Sequence[ChamberRun], number: int) -> dict[str, float]:
    """Errors of the closed-loop prediction of a run by a model of all others."""
    others, run = [r for i, r in enumerate(runs) if i != number], runs[number]
    model = plant_of(others)
    error, about_steps_K = prediction(model, others, run)
    return {"predicted": error, "about_steps_K": about_steps_K, "poles": model.order}


def alone(run: ChamberRun, pooled: LoopModel) -> dict[str, Any]:
    """What a run by itself shows, beside the model of all runs."""
    begun = time.process_time()
    found = suggest(Logs((run.log,), (), SETTINGS))
    cpu_s = time.process_time() - begun
    Ms = found.margins.sensitivity if found.margins else None
    return {
        "says": found.heading().partition(":")[0],
        "replay": run.sentence,
        "replayed": run.replayed,
        "stretches": len(run.parts),
        "samples": sum(part.stretch.samples for part in run.parts),
        "Ms": Ms and Ms.value,
        "low": Ms and Ms.low,
        "high": Ms and Ms.high,
        "pooled_Ms": robustness(pooled, run.gains, SETTINGS).sensitivity,
        "cpu_s": cpu_s,
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def targets_of(rows: Sequence[dict[str, Any]], folder_s: float) -> dict[str, Target]:
    """The targets, of the worst run each."""
    apart = [abs(r["Ms"] / r["pooled_Ms"] - 1.0) for r in rows if r["Ms"]]
    return {
        "replayed": at_most(max(r["replayed"] for r in rows), REPLAYED),
        "with_stretches": at_least(min(r["stretches"] for r in rows), 1.0),
        "predicted": at_most(max(r["predicted"] for r in rows), PREDICTED),
        "about_steps_K": at_most(max(r["about_steps_K"] for r in rows), ABOUT_STEPS_K),
        "apart_from_pooled": at_most(max(apart, default=0.0), POOLED),
        "record_cpu_s": at_most(max(r["cpu_s"] for r in rows), RECORD_s),
        "folder_cpu_s": at_most(folder_s, FOLDER_s),
    }


def main() -> int:
    """Prints a line for each run, or with --json one object; returns 1 where a target is missed.

    Without the data it says so, and returns 0.
    """
    parser = command_line(__doc__, quick="two runs")
    parser.add_argument("--data", type=Path, help="folder that holds oven/")
    options = parser.parse_args()
    data = folder(options.data) / "oven"
    files = sorted(data.glob("run*.csv"))
    if not files:
        reason = f"skipped: {data} has no runs; name the folder above it with --data"
        return print_results({"oven": reason}, {}, as_json=options.json, tables=True)
    runs = [read_run(file) for file in files]
    judged = runs[5:7] if options.quick else runs
    begun = time.process_time()
    pooled = suggest(Logs(tuple(run.log for run in judged), (), SETTINGS)).fit
    folder_s = time.process_time() - begun
    plant = plant_of(judged)
    rows = {
        run.log.name: alone(run, pooled.model)
        | left_out(runs, runs.index(run))
        | {"fitted": prediction(plant, judged, run)[0]}
        for run in judged
    }
    figures = {"runs": rows, "pooled_poles": pooled.order, "folder_cpu_s": folder_s}
    targets = targets_of([*rows.values()], folder_s)
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
