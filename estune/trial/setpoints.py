"""Setpoints from a source above the rig, each in force for a short time, and the feedback."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from estune.errors import InvalidInput

SETPOINT_S = 0.2
"""Time a setpoint is in force, s; then the reel returns to its hold tension."""


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Setpoint of a reel, and the selection of its controller.

    Attributes:
        tension_N: Tension to be held, N.
        angle_rad: Angle of the drum to be held, rad; None selects tension control.
        far_end_m_s: Commanded velocity of the cable's far end, away from the reel, m/s; the
            compensation of a known motion uses it.

    Raises:
        InvalidInput: a number is not finite.
    """

    tension_N: float
    angle_rad: float | None = None
    far_end_m_s: float = 0.0

    def __post_init__(self) -> None:
        numbers = self.tension_N, self.angle_rad or 0.0, self.far_end_m_s
        if not all(map(math.isfinite, numbers)):
            raise InvalidInput(
                f"setpoint {self.tension_N} N, {self.angle_rad} rad, far end {self.far_end_m_s} "
                "m/s: give finite numbers"
            )


@dataclass(frozen=True, slots=True)
class Feedback:
    """State of a reel that follows setpoints.

    Attributes:
        time_s: Time of the readings on the rig's own clock, s.
        tension_N: Measured tension, N.
        angle_rad: Angle of the drum, rad; increases as cable is wound in.
        current_A: Motor current, A.
        reference_N: Tension by an outside sensor, N; None without one.
    """

    time_s: float
    tension_N: float
    angle_rad: float
    current_A: float
    reference_N: float | None = None


@runtime_checkable
class SetpointFollower(Protocol):
    """A rig that follows setpoints between trials."""

    def follow(self, setpoint: Setpoint) -> Feedback:
        """Follows a setpoint for `SETPOINT_S`, and returns at once.

        Without a further one the reel returns to its hold tension by itself. A trial ends the
        following. The guard is in force. Any thread may call.

        Raises:
            InvalidInput: the reel cannot be controlled so; the setpoint before remains.
            RigError: the rig is closed, or held in its safe state.
        """
        ...
