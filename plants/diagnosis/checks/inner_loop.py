"""A drive's command that is a velocity or a position: the setpoint of a loop inside the drive."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.checks.units import within_factor
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion
from plants.diagnosis.models.base import BaseNumbers

UNITS = {
    "the unit of the position": 1.0,
    "degrees": 180.0 / math.pi,
    "turns": 0.5 / math.pi,
    "turns per minute": 30.0 / math.pi,
    "thousandths": 1000.0,
}
"""Units by how many of them a radian, or a metre of a stage, and one per second, are."""


def inner_loop(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    """The command of a free drive that is its velocity, or position, in one of `UNITS`."""
    if not b.is_free or m.angle_rad is None:
        return
    command = m.command_A(b.newtons_per_ampere)
    smoother = Smoother(5.0 / m.sampling_Hz, m.sampling_Hz)
    friction = b.viscous_friction_Nms / (b.newtons_per_ampere * b.drum_radius_m)
    motions = {
        "position": (m.angle_rad, 0.0),
        "velocity": (smoother.sampled(m.angle_rad, 0.0, 1.0), friction),
    }
    for title, (motion, torque_per_motion) in motions.items():
        gain = _gain(command, motion)
        # A command in proportion to the velocity may be the torque that friction needs. Units are
        # far apart: a number of the model's that is off is told from one in another unit.
        if gain is None or within_factor(torque_per_motion / gain):
            continue
        # A loop follows its command to a tenth; what gravity takes is any multiple of the angle.
        unit = next((u for u, f in UNITS.items() if abs(gain / f - 1.0) <= CONSTANTS.small), None)
        if unit is not None:
            sentence = f"it is the {title} in {unit}: the setpoint of a loop inside the drive"
            remedy = "map the torque or the current, or give a [linear_plant] whose input it is"
            yield DataIssue("refused", f"{sentence}, no torque; {remedy}", m.command_column)
            return


def _gain(command: FloatArray, motion: FloatArray) -> float | None:
    """Ratio of a command to the motion that follows it, or None where it explains too little."""
    # The motion may come up to 2 % of the record after the command.
    delays = {round(d) for d in np.linspace(0.0, 0.02 * command.size, 8)}
    tried = [proportion(command[: command.size - late], motion[late:]) for late in delays]
    slope, share = max(tried, key=lambda fitted: fitted[1] if fitted[0] > 0.0 else 0.0)
    # A loop follows its command to a tenth; a torque accelerates, too.
    return 1.0 / slope if slope > 0.0 and share >= 1.0 - CONSTANTS.small**2 else None
