"""Does the diagnosis identify the friction of a measured drive, however its record is cut?

Command: `python -m experiments.emps --data FOLDER`.
Target: friction named in every case, numbers within 2 to 10 % of inverse dynamics, 3.5 N on the
record held out.

EMPS (Janot, Gautier & Brunot 2019) is a carriage on a ball screw in a closed position loop: two
records of 25 s at 1 kHz. The model given has mass and viscous friction. One record is diagnosed
whole, in pieces and resampled, and once with the friction already in the model; the other record,
with force pulses, is held out. The reference is inverse dynamics by least squares. The data are
not part of this project: `--data` or the environment variable ESTUNE_DATA is the folder with
emps/DATA_EMPS.mat.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import plants
from estune.core.quantities import FloatArray
from experiments.measured_data import cut, folder
from experiments.results import Target, at_least, at_most, command_line, print_results
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import CoulombFriction
from plants.models.unloaded_reel import UnloadedReel

FITTED, HELD_OUT = "DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"
NEWTONS_PER_VOLT, RECORDED_Hz = 35.1507, 1000
LOWPASS_Hz, DECIMATION, EDGE = 100.0, 10, 50
"""Filter of the measured position, and parallel decimation, of the inverse dynamics."""
CASES = (*((n, 1000) for n in (1, 2, 3, 4, 5, 6, 8)), (1, 250), (1, 100))
"""Pieces and sampling rates."""
QUICK = ((3, 1000), (1, 250))
LIMITS = {"mass": 0.02, "viscous": 0.05, "coulomb": 0.03, "offset": 0.10}
"""Numbers of the drive: kg, N s/m, N, N; differences allowed from inverse dynamics by the same
law, relative to those of the plain law."""
FURTHER: dict[str, Callable[[FloatArray], FloatArray]] = {
    "directional_friction.difference_Nms": lambda v: 0.5 * np.abs(v),
    "bent_viscous_friction.bend_Nms2": lambda v: v * np.abs(v),
}
"""Forces that further effects add, per unit of their value, over the velocity."""
HELD_OUT_N = 3.5
"""Force error allowed on the record held out."""


class EmpsCase(NamedTuple):
    """One diagnosis of the drive.

    Attributes:
        pieces: Number of files.
        rate_Hz: Sampling rate.
        said: Verdict and effects.
        is_friction: Whether Coulomb friction is named, alone or with a law of `FURTHER`.
        numbers: Numbers of the drive in the order of `LIMITS`, then of `FURTHER`.
        true: The same by inverse dynamics with the same laws.
        inside: Whether the intervals of the first hold the numbers of inverse dynamics.
        held_out_N: Force error on the record held out.
        cpu_s: CPU time taken.
    """

    pieces: int
    rate_Hz: int
    said: str
    is_friction: bool
    numbers: tuple[float, ...]
    true: tuple[float, ...]
    inside: tuple[bool, ...]
    held_out_N: float
    cpu_s: float


def record(file: Path, rate_Hz: int = RECORDED_Hz) -> MeasuredRecord:
    """A record of the drive: its position as an angle in rad, its force as a current in A."""
    from scipy.io import loadmat  # noqa: PLC0415  slow to import

    found, step = loadmat(file), RECORDED_Hz // rate_Hz
    position_m, force_N = found["qm"].ravel(), NEWTONS_PER_VOLT * found["vir"].ravel()
    samples = position_m.size // step
    return MeasuredRecord(
        name=file.stem,
        rig="emps",
        sampling_Hz=float(rate_Hz),
        loop="closed",
        time_s=np.arange(samples) / rate_Hz,
        current_A=force_N[: samples * step].reshape(samples, step).mean(axis=1),
        angle_rad=position_m[: samples * step : step],
    )


def carriage(rate_Hz: int, *effects: CoulombFriction) -> UnloadedReel:
    """A mass with viscous friction: a radius of 1 m makes kilograms of its inertia."""
    return UnloadedReel(
        sampling_Hz=float(rate_Hz),
        torque_constant_Nm_A=1.0,
        drum_radius_m=1.0,
        drum_inertia_kg_m2=95.0,
        viscous_friction_Nms=200.0,
        dead_time_s=0.0,
        encoder_counts=2.0 * np.pi / 5e-8,
        current_limit_A=1e6,
        effects=effects,
    )


class InverseDynamics(NamedTuple):
    """Force and what it depends on, filtered and decimated alike.

    Attributes:
        regressors: Acceleration, velocity, its sign, one, and `FURTHER`; shape (samples, 6).
        force_N: Shape (samples,).
    """

    regressors: FloatArray
    force_N: FloatArray

    @classmethod
    def of(cls, m: MeasuredRecord) -> "InverseDynamics":
        """The regression of a record; the derivatives are those of the filtered position."""
        from scipy.signal import butter, decimate, filtfilt  # noqa: PLC0415  slow to import

        assert m.angle_rad is not None and m.current_A is not None  # noqa: S101, PT018
        low_pass = butter(4, LOWPASS_Hz, fs=m.sampling_Hz)
        v = np.gradient(filtfilt(*low_pass, m.angle_rad), 1.0 / m.sampling_Hz)
        a = np.gradient(v, 1.0 / m.sampling_Hz)
        columns = [a, v, np.sign(v), np.ones_like(v), *(law(v) for law in FURTHER.values())]
        fewer = np.array([decimate(c, DECIMATION)[EDGE:-EDGE] for c in (*columns, m.current_A)])
        return cls(fewer[:-1].T, fewer[-1])

    def numbers(self, further: Sequence[bool] = (False,) * len(FURTHER)) -> FloatArray:
        """Numbers of the drive by least squares, shape (6,); 0 for laws that are not there."""
        there = np.flatnonzero([*(True for _ in LIMITS), *further])
        found = np.zeros(self.regressors.shape[1])
        found[there] = np.linalg.lstsq(self.regressors[:, there], self.force_N, rcond=None)[0]
        return found

    def error_N(self, numbers: FloatArray) -> float:
        """Root mean square of the force that numbers of the drive do not explain."""
        return float(np.sqrt(np.mean((self.force_N - self.regressors @ numbers) ** 2)))


PARAMETERS = (
    *("drum_inertia_kg_m2", "viscous_friction_Nms", "coulomb_friction.torque_Nm"),
    "torque_offset_Nm",
)
SIGNS = np.array([1.0, 1.0, 1.0, -1.0, *(1.0 for _ in FURTHER)])
"""The model's parameters in the order of `LIMITS`; its offset is of the force given."""


def diagnose(data: Path, pieces: int, rate_Hz: int) -> EmpsCase:
    """The diagnosis of the record, cut and resampled."""
    parts = list(cut(record(data / FITTED, rate_Hz), pieces))
    begun = time.process_time()
    answer = plants.explain(carriage(rate_Hz), parts)
    took = time.process_time() - begun
    names = [effect.name for effect in answer.effects]
    known = {CoulombFriction.name, *(name.partition(".")[0] for name in FURTHER)}
    is_friction = answer.verdict in ("named", "incomplete") and CoulombFriction.name in names
    found = {one.name: one.with_effects for one in answer.calibrations}
    found |= {f"{e.name}.{n}": one for e in answer.effects for n, one in e.parameters.items()}
    listed = [found.get(name) for name in (*PARAMETERS, *FURTHER)]
    numbers = SIGNS * [0.0 if one is None else one.value for one in listed]
    dynamics = InverseDynamics.of(record(data / FITTED))
    true = dynamics.numbers([one is not None for one in listed[len(LIMITS) :]])
    inside = [
        one is not None and bool(one.low <= at <= one.high)
        for one, at in zip(listed[: len(LIMITS)], SIGNS * true, strict=False)
    ]
    return EmpsCase(
        pieces,
        rate_Hz,
        f"{answer.verdict} {' + '.join(names)}".strip(),
        is_friction and set(names) <= known,
        tuple(numbers.tolist()),
        tuple(true.tolist()),
        tuple(inside),
        InverseDynamics.of(record(data / HELD_OUT)).error_N(numbers),
        took,
    )


def with_friction(data: Path, coulomb_N: float) -> dict[str, Any]:
    """The diagnosis with the friction in the model given, and its errors on the record held out.

    Errors are of short predictions, in times the noise floor, of the model as refitted and of the
    model with what is named.
    """
    given = carriage(RECORDED_Hz, CoulombFriction(torque_Nm=coulomb_N))
    answer = plants.explain(given, [record(data / FITTED)])
    aside = record(data / HELD_OUT)
    errors = []
    for model in (answer.base_model, answer.augmented):
        predictor = Predictor(diagnosed(model, [aside]), (), [aside])
        errors.append(float(np.sqrt(np.mean(predictor.residuals(predictor.start[None]) ** 2))))
    said = f"{answer.verdict} {' + '.join(e.name for e in answer.effects)}".strip()
    return {"said": said, "held_out_before": errors[0], "held_out_after": errors[1]}


def targets(cases: list[EmpsCase], plain: FloatArray) -> dict[str, Target]:
    """Targets of every case; `plain` are the numbers of the plain law, shape (6,)."""
    differences = np.array([np.subtract(one.numbers, one.true) for one in cases])
    apart = np.abs(differences[:, : len(LIMITS)] / plain[: len(LIMITS)]).max(axis=0)
    return {
        "emps_friction_named": at_least(float(all(one.is_friction for one in cases)), 1.0),
        **{
            f"emps_{name}_off": at_most(float(worst), limit)
            for worst, (name, limit) in zip(apart, LIMITS.items(), strict=True)
        },
        "emps_intervals_hold": at_least(float(np.mean([one.inside for one in cases])), 1.0),
        "emps_held_out_N": at_most(max(one.held_out_N for one in cases), HELD_OUT_N),
    }


def main() -> int:
    """Prints a line for each case, or with --json one object; returns 1 where a target is missed.

    Without the data it says so, and returns 0.
    """
    parser = command_line(__doc__, quick="two cases at low rates")
    parser.add_argument("--data", type=Path, help="folder that holds emps/DATA_EMPS.mat")
    options = parser.parse_args()
    data = folder(options.data) / "emps"
    if not (data / FITTED).exists():
        reason = f"skipped: {data / FITTED} is not there; name the folder with --data"
        return print_results({"emps": reason}, {}, as_json=options.json, tables=True)
    plain = InverseDynamics.of(record(data / FITTED)).numbers()
    cases = [diagnose(data, *case) for case in (QUICK if options.quick else CASES)]
    beside = {} if options.quick else with_friction(data, float(plain[2]))
    figures = {
        "cases": {f"{one.pieces} pieces, {one.rate_Hz} Hz": one._asdict() for one in cases},
        "with_friction": beside,
    }
    return print_results(figures, targets(cases, plain), as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
