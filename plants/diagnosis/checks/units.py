"""Plausibility of the channels' sizes: columns that seem to be in another unit."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers

FACTOR_MAX = 20.0
"""Factor by which no model is wrong."""
UNIT_FACTOR = 1.6
"""Factor within which a ratio is taken for that of two units; the model may be off by as much."""
DEGREE = 180.0 / math.pi
THOUSAND = 1000.0
R2_MIN = 0.5
"""Share of a channel's variance that another must explain for their ratio to mean something."""
WIDTH = 0.01
"""Smoothing, as a share of the record."""


def mistaken_units(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    """Columns that seem to be in another unit: refused where the unit is clear.

    A reel's tension follows the angle by k R and the command by about one; a drum's
    acceleration follows the command by R/J. Judged by factors of twenty and more.
    """
    if b.linear is not None:
        return
    effort = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere
    smoother = Smoother(max(WIDTH * m.duration_s, 1.0 / m.sampling_Hz), m.sampling_Hz)
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
    yield from _issues(m, by_angle, by_effort)


def _issues(
    m: MeasuredRecord, by_angle: float | None, by_effort: float | None
) -> Iterator[DataIssue]:
    """Issues by the slopes relative to the model's; both of them depend on the tension."""
    if by_effort is not None and _is_far(by_effort):
        if by_angle is None or _is_far(by_angle):
            yield _issue("tension_N", by_effort, "what the command holds", {1 / THOUSAND: "kN"})
            return
        open_loop = m.loop == "open" and m.setpoint_N is not None
        column, unit = ("setpoint_N", "N") if open_loop else ("current_A", "A")
        units = {THOUSAND: f"m{unit}", 1.0 / THOUSAND: f"k{unit}"}
        yield _issue(column, 1.0 / by_effort, "what the tension takes", units)
    elif by_angle is not None and _is_far(by_angle):
        yield _issue("angle_rad", 1.0 / by_angle, "what the model turns", {DEGREE: "degrees"})


def _issue(column: str, times: float, what: str, units: dict[float, str]) -> DataIssue:
    near = [u for f, u in units.items() if 1 / UNIT_FACTOR < times / f < UNIT_FACTOR]
    sentence = f"its changes are {times:.3g} times {what}"
    if not near:
        return DataIssue("warning", f"{sentence}; check the unit and the model", column)
    proper = column.rpartition("_")[2]
    sentence += f": it seems to be in {near[0]}; give {proper}"
    return DataIssue("refused", sentence, column)


def _is_far(ratio: float) -> bool:
    return not 1.0 / FACTOR_MAX < ratio < FACTOR_MAX


def _slope(x: FloatArray, y: FloatArray) -> float | None:
    """Slope of y by x, or None where they have too little to do with each other."""
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() < 8:
        return None
    x, y = x[known] - x[known].mean(), y[known] - y[known].mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    if not (xx > 0.0 and yy > 0.0 and xy**2 > R2_MIN * xx * yy):
        return None
    return xy / xx if xy > 0.0 else None
