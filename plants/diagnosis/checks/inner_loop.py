"""A drive's command that is a velocity or a position: the setpoint of a loop inside the drive."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion
from plants.diagnosis.models.base import BaseNumbers

R2_MIN = 0.98
"""Share of the command that a velocity or a position explains, from which on it is one. A loop
that follows to a tenth of its command explains 0.99; a torque has to accelerate, too."""
NEAR = 1.1
"""Factor within which the ratio of command and motion is that of two units."""
LIKE_FRICTION = 3.0
"""Factor about the model's viscous friction within which a command that is proportional to the
velocity is taken for the torque that friction needs."""
UNITS = {
    "the unit of the position": 1.0,
    "degrees": 180.0 / math.pi,
    "turns": 0.5 / math.pi,
    "turns per minute": 30.0 / math.pi,
    "thousandths": 1000.0,
}
"""Units by how many of them a radian, or a metre of a stage, and one per second, are."""
SMOOTHED_samples = 5
LATE = 0.02
"""Longest delay of the motion behind the command that is tried, as a share of the record."""
DELAYS = 8


def inner_loop(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    """The command of a free drive that is its velocity, or position, in one of `UNITS`."""
    if not b.is_free or m.angle_rad is None:
        return
    column = "setpoint_N" if m.loop == "open" and m.setpoint_N is not None else "current_A"
    command = m.command_A(b.newtons_per_ampere)
    smoother = Smoother(SMOOTHED_samples / m.sampling_Hz, m.sampling_Hz)
    friction = b.viscous_friction_Nms / (b.newtons_per_ampere * b.drum_radius_m)
    motions = {
        "position": (m.angle_rad, 0.0),
        "velocity": (smoother.sampled(m.angle_rad, 0.0, 1.0), friction),
    }
    for title, (motion, torque_per_motion) in motions.items():
        gain = _gain(command, motion)
        if gain is None or 1.0 / LIKE_FRICTION < torque_per_motion / gain < LIKE_FRICTION:
            continue
        unit = next((u for u, f in UNITS.items() if 1.0 / NEAR < gain / f < NEAR), None)
        if unit is not None:
            said = f"it is the {title} in {unit}: the setpoint of a loop inside the drive"
            remedy = "map the torque or the current, or give a [linear_plant] whose input it is"
            yield DataIssue("refused", f"{said}, no torque; {remedy}", column)
            return


def _gain(command: FloatArray, motion: FloatArray) -> float | None:
    """Ratio of a command to the motion that follows it, or None where it explains too little."""
    delays = {round(d) for d in np.linspace(0.0, LATE * command.size, DELAYS)}
    tried = [proportion(command[: command.size - late], motion[late:]) for late in delays]
    slope, share = max(tried, key=lambda one: one[1] if one[0] > 0.0 else 0.0)
    return 1.0 / slope if slope > 0.0 and share >= R2_MIN else None
