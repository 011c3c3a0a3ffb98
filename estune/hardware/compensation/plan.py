"""Compensations of a rig as plain values, and their values at one sample."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

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
        angle_map_N: Feed-forward of the map over the drum's angle, added to the effort.
        notch_N: What the notches take off the tension at the gauge.
        eyelet_N: What the gauge reads more than there is outside the eyelet, along the known
            motion.
        limit_N: Greatest size of the whole effort that the drive gives, for the anti-windup;
            zero where it is that of the rig.
    """

    velocity_rad_s: float
    gravity_N: float
    friction_N: float
    inertia_N: float
    angle_map_N: float
    notch_N: float
    eyelet_N: float
    limit_N: float

    @property
    def feed_forward_N(self) -> float:
        """Effort beside that of the controller, N."""
        return self.friction_N + self.inertia_N + self.angle_map_N

    @property
    def off_gauge_N(self) -> float:
        """What the controlled tension is less than that at the gauge, N."""
        return self.gravity_N + self.notch_N + self.eyelet_N

    def columns(self, amperes_per_newton: float) -> dict[str, Any]:
        """The terms, numbers or arrays of them, as the columns of a record."""
        return {
            "drum_velocity_rad_s": self.velocity_rad_s,
            "gravity_N": self.gravity_N,
            "friction_A": self.friction_N * amperes_per_newton,
            "inertia_A": self.inertia_N * amperes_per_newton,
            "angle_map_A": self.angle_map_N * amperes_per_newton,
            "notch_N": self.notch_N,
            "eyelet_N": self.eyelet_N,
            "current_limit_A": self.limit_N * amperes_per_newton,
        }


NO_COMPENSATION = CompensationTerms(*[0.0] * 8)


class Wave(NamedTuple):
    """One wave of a map over the drum's angle: `(force_N + load_share r) sin(N theta + phi)`.

    Attributes:
        order: Periods N in a turn of the drum.
        force_N: Amplitude of the effort, N.
        load_share: Amplitude relative to the setpoint r, as an eccentric drum asks for.
        phase_rad: Phase phi at the map's zero, rad.
    """

    order: float
    force_N: float
    load_share: float
    phase_rad: float


@dataclass(frozen=True, slots=True)
class AngleMap:
    """Effort over the drum's angle.

    Attributes:
        zero_rad: Angle read at the map's zero, rad; wrong by a sixth of a period, the map makes
            the ripple worse.
        lead_s: Time from a reading to the middle of the sample in which its effort acts, s; the
            angle is taken as far ahead as the drum turns in it.
    """

    waves: tuple[Wave, ...]
    zero_rad: float
    lead_s: float

    def force_N(self, angle_rad: float, velocity_rad_s: float, setpoint_N: float) -> float:
        """The effort at a sample, N."""
        ahead = angle_rad - self.zero_rad + velocity_rad_s * self.lead_s
        load = max(setpoint_N, 0.0)
        return sum(
            (force + share * load) * math.sin(order * ahead + phase)
            for order, force, share, phase in self.waves
        )


class Notch(NamedTuple):
    """A notch as a difference equation, `y = b0 x + b1 x' + b2 x'' - a1 y' - a2 y''`."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float

    @classmethod
    def at(cls, frequency_Hz: float, width_Hz: float, depth: float, sampling_Hz: float) -> "Notch":
        """The notch at a frequency.

        Args:
            frequency_Hz: Its middle, below half the sampling rate.
            width_Hz: Width between the points of -3 dB of a notch to zero.
            depth: Gain in its middle; one is no notch.
        """
        from scipy.signal import iirnotch  # noqa: PLC0415  slow to import

        b, a = iirnotch(frequency_Hz, frequency_Hz / width_Hz, fs=sampling_Hz)
        numerator = depth * a + (1.0 - depth) * b
        b_0, b_1, b_2 = map(float, numerator)
        return cls(b_0, b_1, b_2, float(a[1]), float(a[2]))


class EyeletFeedForward(NamedTuple):
    """Friction of the cable at the eyelet, `T exp(exponent z)` at the gauge, T outside.

    Attributes:
        exponent: Logarithm of the tension inside over that outside while winding in.
        memory_rad: Motion over which the direction z of sliding turns by 63 %, rad.
    """

    exponent: float
    memory_rad: float


@dataclass(frozen=True, slots=True)
class Gravity:
    """Weight of the deployed cable.

    Attributes:
        weight_N_m: Weight per length, N/m.
        rise_m: Height of the far end above the reel, m.
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
        tension_per_rad_N: Rise of the tension per angle of the drum, the far end held, N/rad.
        inertia_kgm2: Inertia fed forward along the measured acceleration, kg m2; zero where off.
        known_viscous_Nms_rad: Viscous friction, likewise, N m per rad/s.
        effort_limit_N: Greatest effort that the drive gives, N; zero where it is the rig's.
        feed_forward_max_N: Greatest size of all that is fed forward, N.
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
    angle_map: AngleMap | None
    notches: tuple[Notch, ...]
    eyelet: EyeletFeedForward | None
    effort_limit_N: float
    drum_radius_m: float
    feed_forward_max_N: float
    columns: tuple[str, ...]

    def limited_N(self, effort_N: float) -> float:
        """An effort within the greatest feed-forward, N; zero where it is not a number."""
        if math.isnan(effort_N):
            return 0.0
        return min(max(effort_N, -self.feed_forward_max_N), self.feed_forward_max_N)
