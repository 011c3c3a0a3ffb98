"""Whether the channels' sizes fit the model, or a column is in another unit than it says."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers

FAR = 20.0
"""Factor that no calibration is off by."""
NEARLY = 1.6
"""Factor within which a ratio is taken for that of two units; the model may be off by as much."""
DEGREE = 180.0 / math.pi
THOUSAND = 1000.0
CLEAR = 0.5
"""Share of a channel's variance that another must explain for their ratio to mean something."""
WIDTH = 0.01
"""Smoothing, as a share of the record."""


class Doubt(NamedTuple):
    """A column whose size does not fit the model.

    Attributes:
        column: Its name.
        unit: The unit it seems to be in, or empty where no unit would make it fit.
        sentence: What is wrong and what to do.
    """

    column: str
    unit: str
    sentence: str


def mistaken_units(m: MeasuredRecord, b: BaseNumbers) -> Iterator[Doubt]:
    """The columns that seem to be in another unit.

    A reel's tension goes with the angle by k R and with the command by about one; a drum's
    acceleration with the command by R/J. Judged by factors of twenty and more.
    """
    if b.linear is not None:
        return
    effort = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere
    smoother = Smoother(max(WIDTH * m.duration_s, 1.0 / m.sampling_Hz), m.sampling_Hz)
    u = smoother.held(effort, b.dead_time_s, 1.0)
    by_angle = by_effort = None
    if m.tension_N is not None and b.stiffness_N_m is not None:
        T = smoother.sampled(m.tension_N, 1.0)
        by_effort = _ratio(u, T)
        if m.angle_rad is not None:
            by_angle = _ratio(smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad), T)
    elif m.angle_rad is not None and b.stiffness_N_m is None:
        torque = smoother.sampled(m.angle_rad, 0.0, b.viscous_friction_Nms, b.drum_inertia_kg_m2)
        by_angle = _ratio(torque, b.drum_radius_m * u)
    elif m.angle_rad is not None:
        by_angle = _ratio(smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad), u)
    yield from _doubts(m, by_angle, by_effort)


def _doubts(m: MeasuredRecord, by_angle: float | None, by_effort: float | None) -> Iterator[Doubt]:
    """What the slopes over those of the model say; both of them speak of the tension."""
    if by_effort is not None and _far(by_effort):
        if by_angle is None or _far(by_angle):
            yield _doubt("tension_N", by_effort, "what the command holds", {1 / THOUSAND: "kN"})
            return
        open_loop = m.loop == "open" and m.setpoint_N is not None
        column, small, large = (
            ("setpoint_N", "mN", "kN") if open_loop else ("current_A", "mA", "kA")
        )
        units = {THOUSAND: small, 1.0 / THOUSAND: large}
        yield _doubt(column, 1.0 / by_effort, "what the tension takes", units)
    elif by_angle is not None and _far(by_angle):
        yield _doubt("angle_rad", 1.0 / by_angle, "what the model turns", {DEGREE: "degrees"})


def _doubt(column: str, times: float, what: str, units: dict[float, str]) -> Doubt:
    near = [unit for factor, unit in units.items() if 1 / NEARLY < times / factor < NEARLY]
    sentence = f"its changes are {times:.3g} times {what}"
    proper = column.rpartition("_")[2]
    if near:
        return Doubt(column, near[0], f"{sentence}: it seems to be in {near[0]}; give {proper}")
    return Doubt(column, "", f"{sentence}; check the unit and the model")


def _far(ratio: float) -> bool:
    return not 1.0 / FAR < ratio < FAR


def _ratio(x: FloatArray, y: FloatArray) -> float | None:
    """Slope of y by x, or None where they have too little to do with each other."""
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() < 8:
        return None
    x, y = x[known] - x[known].mean(), y[known] - y[known].mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    if not (xx > 0.0 and yy > 0.0 and xy**2 > CLEAR * xx * yy):
        return None
    return xy / xx if xy > 0.0 else None
