"""Compensations of a rig as plain values, and their values at one sample."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from estune.reel.friction import FrictionFeedForward
from estune.reel.velocity import Windows


class KnownMotion(NamedTuple):
    """What is known of the drum's motion before it is measured.

    Attributes:
        setpoint_N: Filtered setpoint at the last sample, N; NaN where the loop is open.
        far_end_m_s: Commanded velocity of the cable's far end, away from the reel.
    """

    setpoint_N: float
    far_end_m_s: float = 0.0


NOTHING_KNOWN = KnownMotion(math.nan)


class CompensationTerms(NamedTuple):
    """Compensations at a sample.

    Attributes:
        velocity_rad_s: Velocity of the drum by adaptive windows.
        gravity_N: The cable's weight at the gauge, F_g of (9); the controlled tension is that at
            the gauge less F_g.
        friction_N: Feed-forward of the friction, (10), along the known motion; added to the
            effort.
        inertia_N: Feed-forward of the inertia, added to the effort.
    """

    velocity_rad_s: float
    gravity_N: float
    friction_N: float
    inertia_N: float

    @property
    def feed_forward_N(self) -> float:
        """Effort beside that of the controller, N."""
        return self.friction_N + self.inertia_N


NO_COMPENSATION = CompensationTerms(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Gravity:
    """Weight of the deployed cable.

    Attributes:
        weight_N_m: Weight per length, N/m.
        rise_m: Height of the far end above the reel, m.
        length_m: Deployed length at an angle of zero, m.
        length_min_m: Least length used; beyond it the weight is that of this length, m.
        length_max_m: Greatest length used, m.
    """

    weight_N_m: float
    rise_m: float
    length_m: float
    length_min_m: float
    length_max_m: float

    def length_at(self, angle_rad: float, drum_radius_m: float) -> float:
        """Deployed length at a drum angle, within its range, m."""
        length = self.length_m - drum_radius_m * angle_rad
        return min(max(length, self.length_min_m), self.length_max_m)


@dataclass(frozen=True, slots=True)
class CompensationPlan:
    """Compensations of a loop.

    Attributes:
        period_s: Sampling period, s.
        windows: Estimator of the velocity.
        friction: Friction along the known motion; None where it is off.
        tension_per_rad_N: Rise of the tension per angle of the drum, the far end held, N/rad.
        inertia_kgm2: Inertia fed forward along the measured acceleration, kg m2; zero where off.
        known_inertia_kgm2: Inertia fed forward along the far end's commanded motion, kg m2.
        known_viscous_Nms_rad: Viscous friction, likewise, N m per rad/s.
        gravity: The cable's weight; None where it is off.
        drum_radius_m: Radius of the cable on the drum, m.
        feed_forward_max_N: Greatest size of friction and inertia together, N.
        columns: Names of the columns that a record has of them.
    """

    period_s: float
    windows: Windows
    friction: FrictionFeedForward | None
    tension_per_rad_N: float
    inertia_kgm2: float
    known_inertia_kgm2: float
    known_viscous_Nms_rad: float
    gravity: Gravity | None
    drum_radius_m: float
    feed_forward_max_N: float
    columns: tuple[str, ...]

    def limited_N(self, effort_N: float) -> float:
        """An effort within the greatest feed-forward, N; zero where it is not a number."""
        if math.isnan(effort_N):
            return 0.0
        return min(max(effort_N, -self.feed_forward_max_N), self.feed_forward_max_N)
