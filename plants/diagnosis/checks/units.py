"""Plausibility of the channels' sizes: columns that seem to be in another unit."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion
from plants.diagnosis.models.base import BaseNumbers

_ANGLES = {
    math.degrees(1.0): ("degrees", "give rad, or explain with --unit angle=deg"),
    1e3: (
        "thousandths, as mm or mrad, or the command in kN",
        "give rad, or m of a stage, or explain with --scale angle=0.001",
    ),
    0.5 / math.pi: ("turns", "check it and the inertia, and if so explain with --unit angle=turn"),
}
_COMMANDS = {
    1e3: (
        "thousandths, as mN m, mN or mA",
        "give N m, N or A, or explain with --scale current=0.001",
    ),
}
"""Factors of units that people mistake, with each unit and what to do."""


def mistaken_units(m: MeasuredRecord, b: BaseNumbers, rate_Hz: float) -> Iterator[DataIssue]:
    """Columns that seem to be in another unit: refused where that is clear.

    A reel's tension follows the angle by k R and the command by about one, which is judged by
    factors of twenty and more. A free drive is judged by its balance of torques.
    """
    if b.linear is not None:
        return
    rate_from_ms_Hz = 1000.0 * m.sampling_Hz
    if within_factor(rate_from_ms_Hz / rate_Hz):
        sentence = f"its samples come at {m.sampling_Hz:.3g} Hz, the model's at {rate_Hz:.3g} Hz"
        yield DataIssue("refused", f"{sentence}: it seems to be in ms; give s", "time_s")
        return
    effort = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere
    smoother = Smoother.slow(m.duration_s, m.sampling_Hz)
    u = smoother.held(effort, b.dead_time_s, 1.0)
    by_angle = by_effort = None
    if m.tension_N is not None and b.stiffness_N_m is not None:
        T = smoother.sampled(m.tension_N, 1.0)
        by_effort = _slope(u, T)
        if m.angle_rad is not None:
            by_angle = _slope(smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad), T)
    elif m.angle_rad is not None and b.stiffness_N_m is None:
        yield from _of_drive(m.angle_rad, u, b, m.command_column, smoother)
    elif m.angle_rad is not None:
        by_angle = _slope(smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad), u)
    if b.stiffness_N_m is not None:
        yield from _issues(m, by_angle, by_effort)


def _issues(
    m: MeasuredRecord, by_angle: float | None, by_effort: float | None
) -> Iterator[DataIssue]:
    """Issues by the slopes relative to the model's; both of them depend on the tension."""
    if by_effort is not None and not within_factor(by_effort, CONSTANTS.range):
        if by_angle is None or not within_factor(by_angle, CONSTANTS.range):
            yield _issue("tension_N", by_effort, "what the command holds", {1e-3: "kN"})
            return
        unit = m.command_column.rpartition("_")[2]
        units = {1e3: f"m{unit}", 1e-3: f"k{unit}"}
        yield _issue(m.command_column, 1.0 / by_effort, "what the tension takes", units)
    elif by_angle is not None and not within_factor(by_angle, CONSTANTS.range):
        units = {math.degrees(1.0): "degrees", 1e3: "thousandths, as mm or mrad"}
        yield _issue("angle_rad", 1.0 / by_angle, "what the model turns", units)


def _of_drive(
    angle_rad: FloatArray,
    effort: FloatArray,
    b: BaseNumbers,
    command: str,
    smoother: Smoother,
) -> Iterator[DataIssue]:
    """Columns in whose other unit the model explains most of what it cannot explain in its own."""
    known = np.isfinite(effort)
    torque = b.drum_radius_m * effort[known]
    if torque.size < CONSTANTS.fewest or np.ptp(torque) <= 1e-9 * np.abs(torque).max():
        return
    # Beside all of them, or waves of a motor look like gravity of a link in turns.
    turns = 2.0 * math.pi * angle_rad
    waves = np.column_stack([smoother.sampled(f(turns), 1.0) for f in (np.sin, np.cos)])
    terms = {
        f: np.hstack([torque_terms(angle_rad / f, smoother), waves])[known]
        for f in (1.0, *_ANGLES)
    }
    left = {}
    for f, of_f in terms.items():
        for g in (1.0, *_COMMANDS):
            left[f, g] = _unexplained(of_f, torque / g, b.drum_inertia_kg_m2, CONSTANTS.data_sheet)
    # Fewer columns first where several units do the same.
    best = min(left, key=lambda units: (round(left[units][0], 2), sum(f != 1.0 for f in units)))
    (now, _), (then, seen) = left[1.0, 1.0], left[best]
    if max(best) > CONSTANTS.range:
        # A guess of the inertia ten times off, in rad, was refused as degrees.
        now, _ = _unexplained(terms[1.0], torque, b.drum_inertia_kg_m2, CONSTANTS.range)
    # Unless its inertia is seen, a load on a spring looks like gravity in degrees.
    if then >= CONSTANTS.law_left * min(now, 1.0, seen):
        return
    for column, table, factor in (("angle_rad", _ANGLES, best[0]), (command, _COMMANDS, best[1])):
        if factor != 1.0:
            unit, remedy = table[factor]
            sentence = (
                f"the model leaves {min(now, 1.0):.1%} of the command's power, {then:.1%} with "
                f"this column divided by {factor:.4g}: it seems to be in {unit}; {remedy}"
            )
            # A model may be off by 2 pi, too: it is said, and the record is used.
            is_clear = factor > CONSTANTS.range
            yield DataIssue("refused" if is_clear else "warning", sentence, column)


def torque_terms(angle_rad: FloatArray, smoother: Smoother) -> FloatArray:
    """What a torque may be made of: inertia first, friction, a constant, and gravity of a link."""
    # The sign of a smooth velocity is not that of the velocity, smoothed.
    sharp = smoother._replace(width_s=max(0.1 * smoother.width_s, 1.0 / smoother.sampling_Hz))
    way = np.sign(np.nan_to_num(sharp.sampled(angle_rad, 0.0, 1.0)))
    return np.column_stack(
        [
            smoother.sampled(angle_rad, 0.0, 0.0, 1.0),
            smoother.sampled(angle_rad, 0.0, 1.0),
            smoother.sampled(way, 1.0),
            np.ones(angle_rad.size),
            *(smoother.sampled(f(angle_rad), 1.0) for f in (np.sin, np.cos)),
        ]
    )


def _unexplained(
    terms: FloatArray, torque: FloatArray, inertia: float, within: float
) -> tuple[float, float]:
    """Share of a torque's power left with an inertia within a factor of one, and with none."""
    sizes = np.linalg.lstsq(terms, torque, rcond=1e-9)[0]
    fitted = float(np.clip(sizes[0], inertia / within, inertia * within))
    rest = np.column_stack([torque - fitted * terms[:, 0], torque])
    rest -= terms[:, 1:] @ np.linalg.lstsq(terms[:, 1:], rest, rcond=1e-9)[0]
    moved = max(float(np.sum((torque - torque.mean()) ** 2)), 1e-300)
    left, without = (np.sum(rest**2, axis=0) / moved).tolist()
    return left, without


def _issue(column: str, times: float, what: str, units: dict[float, str]) -> DataIssue:
    near = [u for f, u in units.items() if within_factor(times / f)]
    sentence = f"its changes are {times:.3g} times {what}"
    if not near:
        return DataIssue("warning", f"{sentence}; check the unit and the model", column)
    proper = "rad, or m of a stage" if column == "angle_rad" else column.rpartition("_")[2]
    sentence += f": it seems to be in {near[0]}; give {proper}"
    return DataIssue("refused", sentence, column)


def within_factor(ratio: float, factor: float | None = None) -> bool:
    """Whether a ratio is one, but for a factor either way (by default of a model's numbers)."""
    most = CONSTANTS.model_off if factor is None else factor
    return 1.0 / most < ratio < most


def _slope(x: FloatArray, y: FloatArray) -> float | None:
    """Slope of y by x, or None where they have too little to do with each other."""
    slope, share = proportion(x, y)
    return slope if slope > 0.0 and share > 0.5 else None
