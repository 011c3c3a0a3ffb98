"""Friction fed forward along the known motion, of a simulated trial: known before it begins."""

from typing import NamedTuple

import numpy as np

from estune.core import pidf
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.reel.friction import FrictionFeedForward
from plants.simulation.plant import TrialSetpoint


class KnownFriction(NamedTuple):
    """Friction that a loop feeds forward.

    Attributes:
        law: The law.
        tension_per_rad_N: Rise of the tension per angle of the drum, N/rad.
        drum_radius_m: Radius of the cable on the drum, m.
    """

    law: FrictionFeedForward
    tension_per_rad_N: float
    drum_radius_m: float

    def along(
        self, controller: ControllerSettings, gains: Gains, drive: TrialSetpoint
    ) -> FloatArray:
        """Force fed forward at each sample of a trial, N; none in an open loop."""
        if drive.open_loop:
            return np.zeros(drive.time_s.size)
        pole = pidf.coefficients(controller, gains).setpoint_pole
        steps = drive.setpoint_N - drive.preload_N
        filtered = drive.preload_N + lfilter([1.0 - pole], [1.0, -pole], steps)
        return self.force_N(filtered, 1.0 / controller.sampling_Hz)

    def force_N(self, filtered_N: FloatArray, period_s: float) -> FloatArray:
        """Force fed forward at each sample, along the filtered setpoint of the one before, N."""
        moved = np.diff(filtered_N, prepend=filtered_N[0]) / self.tension_per_rad_N
        direction, forces = 0.0, np.zeros(filtered_N.size)
        for k in range(1, filtered_N.size):
            angle = float(moved[k - 1])
            direction = self.law.direction(direction, angle)
            tension = float(filtered_N[k - 1])
            velocity = angle / period_s
            forces[k] = self.law.force_N(direction, velocity, tension, self.drum_radius_m)
        return forces
