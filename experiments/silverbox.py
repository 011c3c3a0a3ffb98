"""Does the diagnosis identify the cubic spring of the Silverbox from measured data?

Command: `python -m experiments.silverbox --data FOLDER`.
Target: stiffening ranked first, normalised rms error of at most 0.022 with it.

The Silverbox (Wigren & Schoukens 2013) is an electronic oscillator with a cubic spring, a measured
free benchmark: one long record of growing noise, and a Schroeder multisine as test data. The model
given is the best linear one: a second-order system fitted to the long record. The data are not
part of this project: `--data` or the environment variable ESTUNE_DATA is the folder with
silverbox/Silverbox.mat.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import plants
from estune.core.quantities import FloatArray
from experiments.measured_data import folder
from experiments.results import Target, at_least, at_most, command_line, print_results
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor

SAMPLING_HZ = 1e7 / 2**14
SETTLING = 100
"""Samples at the start of the multisine that are not counted: its initial state is unknown."""

EXPECTED = "cable_stiffening"
LIMIT_NRMSE = 0.022
"""Error allowed on the multisine, relative to its standard deviation."""


def figures(data: Path) -> dict[str, Any]:
    """The figures by name; without the data, the reason for none."""
    file = data / "silverbox" / "Silverbox.mat"
    if not file.exists():
        return {"silverbox": f"skipped: {file} is not there; name the folder with --data"}
    long, aside = _records(file)
    model = _linear(long)
    answer = plants.explain(model, [long])
    first = answer.candidates[0].name if answer.candidates else ""
    return {
        "silverbox": f"{answer.verdict} {' + '.join(e.name for e in answer.effects)}".strip(),
        "silverbox_first_candidate": first,
        "silverbox_stiffening_first": float(
            bool(answer.effects) and answer.effects[0].name == EXPECTED
        ),
        "silverbox_nrmse_given": _nrmse(model, aside),
        "silverbox_nrmse_before": _nrmse(answer.base_model, aside),
        "silverbox_nrmse_after": _nrmse(answer.augmented, aside),
        "silverbox_free_run_ratio": answer.after.rms / answer.before.rms,
    }


def targets(figures: Mapping[str, Any]) -> dict[str, Target]:
    """Targets; none without the data."""
    if "silverbox_nrmse_after" not in figures:
        return {}
    first, after = figures["silverbox_stiffening_first"], figures["silverbox_nrmse_after"]
    return {
        "silverbox_stiffening_first": at_least(first, 1.0),
        "silverbox_nrmse_after": at_most(after, LIMIT_NRMSE),
    }


def _records(file: Path) -> tuple[MeasuredRecord, MeasuredRecord]:
    from scipy.io import loadmat  # noqa: PLC0415  slow to import

    contents = loadmat(file)
    long = _measurement("long", contents["U"].ravel(), contents["Y"].ravel())
    return long, _measurement("multisine", contents["U_val"].ravel(), contents["Y_val"].ravel())


def _measurement(name: str, u: FloatArray, y: FloatArray) -> MeasuredRecord:
    """Volts in and out, in the columns of effort and measurement."""
    return MeasuredRecord(
        name=name,
        rig="silverbox",
        sampling_Hz=SAMPLING_HZ,
        loop="open",
        time_s=np.arange(u.size) / SAMPLING_HZ,
        setpoint_N=u,
        tension_N=y,
    )


def _linear(record: MeasuredRecord) -> Any:
    """The second-order system that follows the record best in free run."""
    import control  # noqa: PLC0415  slow to import
    from scipy.optimize import least_squares  # noqa: PLC0415
    from scipy.signal import cont2discrete, lfilter  # noqa: PLC0415

    u, y = record.setpoint_N, record.tension_N
    if u is None or y is None:
        raise ValueError("a record without input or output")

    def system(x: FloatArray) -> tuple[list[float], list[float]]:
        gain, rate, damping = np.exp(x)
        return [gain * rate**2], [1.0, 2.0 * damping * rate, rate**2]

    def error(x: FloatArray) -> FloatArray:
        numerator, denominator, _ = cont2discrete(system(x), 1.0 / SAMPLING_HZ)
        answer: FloatArray = lfilter(numerator.ravel(), denominator, u) - y
        return answer

    rates = 2.0 * np.pi * np.geomspace(20.0, 200.0, 40)
    start = min(
        (np.log([1.0, w, 0.05]) for w in rates), key=lambda x: float(np.sum(error(x) ** 2))
    )
    best = least_squares(error, start, x_scale=[1.0, 0.1, 1.0]).x
    return plants.linear_plant(control.tf(*system(best)), sampling_Hz=SAMPLING_HZ)


def _nrmse(model: Any, record: MeasuredRecord) -> float:
    """Error of the model's free run relative to the standard deviation of the measurement."""
    predictor = Predictor(diagnosed(model, [record]), (), [record], horizon_s=None)
    predicted = predictor.predict(predictor.start[None, :])[0].tension_N
    if predicted is None or record.tension_N is None:
        raise ValueError("the model predicts no output")
    error, measured = predicted[0] - record.tension_N, record.tension_N
    return float(np.std(error[SETTLING:]) / np.std(measured[SETTLING:]))


def main() -> int:
    """Prints the figures, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="no shorter form")
    parser.add_argument("--data", type=Path, help="folder that holds silverbox/Silverbox.mat")
    options = parser.parse_args()
    values = figures(folder(options.data))
    return print_results(values, targets(values), as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
