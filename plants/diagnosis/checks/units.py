"""Plausibility of the channels' sizes: columns that seem to be in another unit."""

import math
from collections.abc import Iterator

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion
from plants.diagnosis.models.base import BaseNumbers


def mistaken_units(m: MeasuredRecord, b: BaseNumbers, rate_Hz: float) -> Iterator[DataIssue]:
    """Columns that seem to be in another unit: refused where that is clear.

    A reel's tension follows the angle by k R and the command by about one; of a free drum the
    command accelerates the inertia and works against friction. Judged by factors of twenty and
    more.
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
        torque = smoother.sampled(m.angle_rad, 0.0, b.viscous_friction_Nms, b.drum_inertia_kg_m2)
        by_angle = _slope(torque, b.drum_radius_m * u)
    elif m.angle_rad is not None:
        by_angle = _slope(smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad), u)
    if b.stiffness_N_m is not None:
        yield from _issues(m, by_angle, by_effort)
    elif by_angle is not None:
        yield from _issues_of_drive(m, 1.0 / by_angle)


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


def _issues_of_drive(m: MeasuredRecord, times: float) -> Iterator[DataIssue]:
    """Issues by the torque that the motion takes, relative to the command."""
    # A model may be off by 2 pi, too: it is said, and the record is used.
    if within_factor(times * 2.0 * math.pi):
        sentence = "its changes are 1/6.28 of what the model turns, the ratio of turns to rad"
        yield DataIssue("warning", f"{sentence}; check the unit and the inertia", "angle_rad")
    elif not within_factor(times, CONSTANTS.range) and times < 1.0:
        unit = "thousandths, as mN m, mN or mA"
        yield _issue(m.command_column, 1.0 / times, "what the motion takes", {1e3: unit})
    elif not within_factor(times, CONSTANTS.range):
        thousandths = "thousandths, as mm or mrad, or the command in kN"
        units = {math.degrees(1.0): "degrees", 1e3: thousandths}
        yield _issue("angle_rad", times, "what the model turns", units)


def _issue(column: str, times: float, what: str, units: dict[float, str]) -> DataIssue:
    near = [u for f, u in units.items() if within_factor(times / f)]
    sentence = f"its changes are {times:.3g} times {what}"
    if not near:
        return DataIssue("warning", f"{sentence}; check the unit and the model", column)
    proper = "rad, or m of a stage" if column == "angle_rad" else column.rpartition("_")[2]
    proper = "N m, N or A" if "mN m" in near[0] else proper
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
