"""Live gains, which hold the reel between trials: fixed, or scheduled over the cable length."""

import math
from dataclasses import dataclass

from estune.core import pidf
from estune.core.pidf import Coefficients, ControllerSettings
from estune.core.schedule import GainSchedule

LENGTH_STEP_m = 1e-3
TENSION_STEP_N = 0.1
"""Change of length or tension after which the gains are computed anew: 10 us of Python that would
otherwise be spent at every sample."""


@dataclass(frozen=True, slots=True)
class LengthSource:
    """Gain schedule with the cable length that the drum angle gives.

    Attributes:
        length_m: Cable length at an angle of zero, m.
    """

    schedule: GainSchedule
    settings: ControllerSettings
    length_m: float
    drum_radius_m: float

    def length_at(self, angle_rad: float) -> float:
        """Cable length at a drum angle, m; the angle grows as the cable is wound in."""
        return self.length_m - self.drum_radius_m * angle_rad


class LiveGains:
    """Gains that hold the reel between trials.

    Attributes:
        operating_point: Cable length in m and tension in N that they are for; NaN if fixed.
    """

    def __init__(self, fixed: Coefficients, length_source: LengthSource | None) -> None:
        self.coefficients = fixed
        self.operating_point = (math.nan, math.nan)
        self._source = length_source

    def fix(self, coefficients: Coefficients) -> None:
        """Makes these the live gains at any length; ends a schedule."""
        self.coefficients, self._source = coefficients, None
        self.operating_point = (math.nan, math.nan)

    def update(self, angle_rad: float, tension_N: float) -> bool:
        """Whether a schedule gives other gains now, at this drum angle and setpoint."""
        source = self._source
        if source is None:
            return False
        length = source.length_at(angle_rad)
        last_length, last_tension = self.operating_point
        if (
            abs(length - last_length) < LENGTH_STEP_m
            and abs(tension_N - last_tension) < TENSION_STEP_N
        ):
            return False
        self.operating_point = length, tension_N
        gains = source.schedule.gains(length, tension_N)
        self.coefficients = pidf.coefficients(source.settings, gains)
        return True
