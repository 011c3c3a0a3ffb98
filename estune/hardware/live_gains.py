"""The live gains: those that hold the reel between trials, fixed or by a schedule over length."""

import math
from dataclasses import dataclass

from estune.core import pidf
from estune.core.pidf import Coefficients, ControllerSettings
from estune.core.schedule import GainSchedule

LENGTH_STEP_m = 1e-3
TENSION_STEP_N = 0.1
"""By how much length or tension has changed before the gains are computed anew: 10 us of Python
that would otherwise be spent at every sample."""


@dataclass(frozen=True, slots=True)
class LengthSource:
    """How the live gains follow the cable's length.

    Attributes:
        schedule: The gains over length and tension.
        settings: The fixed part of the controller.
        length_m: Cable length at an angle of zero, or until another is told, m.
        drum_radius_m: What a radian of winding in takes from it, m; zero where the length is told.
    """

    schedule: GainSchedule
    settings: ControllerSettings
    length_m: float
    drum_radius_m: float

    def length_at(self, angle_rad: float) -> float:
        """Cable length at a drum angle, m; the angle grows as the cable is wound in."""
        return self.length_m - self.drum_radius_m * angle_rad


class LiveGains:
    """The gains that hold the reel between trials.

    Attributes:
        coefficients: Their difference equation as it is now.
        used: Cable length in m and tension in N that they are for; not numbers where they are
            fixed.
    """

    def __init__(self, fixed: Coefficients, following: LengthSource | None) -> None:
        self.coefficients = fixed
        self.used = (math.nan, math.nan)
        self._following = following
        self._told_m = math.nan if following is None else following.length_m

    def fix(self, coefficients: Coefficients) -> None:
        """Makes these the live gains, at any length: a schedule is no longer followed."""
        self.coefficients, self._following = coefficients, None
        self.used = (math.nan, math.nan)

    def set_length(self, length_m: float) -> None:
        """Says how long the cable is, m."""
        self._told_m = length_m

    def update(self, angle_rad: float, tension_N: float) -> bool:
        """Whether the gains are others now, at this drum angle and setpoint."""
        following = self._following
        if following is None:
            return False
        told = following.drum_radius_m == 0.0
        length = self._told_m if told else following.length_at(angle_rad)
        length_used, tension_used = self.used
        if (
            abs(length - length_used) < LENGTH_STEP_m
            and abs(tension_N - tension_used) < TENSION_STEP_N
        ):
            return False
        self.used = length, tension_N
        gains = following.schedule.gains(length, tension_N)
        self.coefficients = pidf.coefficients(following.settings, gains)
        return True
