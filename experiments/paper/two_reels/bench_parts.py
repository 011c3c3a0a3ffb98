"""Parts of a simulated two-reel bench: eyelets, gauges, controllers."""

import math
from dataclasses import dataclass, field

from estune.core.quantities import check_not_negative, check_positive
from experiments.paper.two_reels.friction_ratio import attenuation


@dataclass(frozen=True, slots=True)
class Eyelet:
    """Friction at the cable's entry to a reel.

    The static coefficient falls to a dynamic one with the velocity, (10). It may grow with the
    velocity, and with the tension inside, in deviation from Coulomb's law.
    """

    coefficient: float = 0.1  # static friction coefficient C_R at no tension
    # Angle gamma at each contact between gauge and free cable, rad.
    angles_rad: tuple[float, ...] = (2.1,)
    dynamic_share: float = 1.0  # dynamic over static coefficient
    stribeck_m_s: float = 0.02  # velocity of the transition, m/s
    viscous_s_m: float = 0.0  # growth of the coefficient with velocity, s/m
    growth_per_N: float = 0.0  # growth of the coefficient with tension, 1/N
    variation: float = 0.005  # relative variation of the coefficient between approaches, rms

    def __post_init__(self) -> None:
        attenuation(self.coefficient, *self.angles_rad)
        for name in ("dynamic_share", "viscous_s_m", "variation"):
            check_not_negative(name, getattr(self, name))
        check_positive("stribeck_m_s", self.stribeck_m_s)

    def coefficient_at(self, tension_N: float, velocity_m_s: float = 0.0) -> float:
        """Friction coefficient C_R at a tension inside and a sliding velocity."""
        static = self.coefficient + self.growth_per_N * tension_N
        fade = math.exp(-((velocity_m_s / self.stribeck_m_s) ** 2))
        share = self.dynamic_share + (1.0 - self.dynamic_share) * fade
        return static * share + self.viscous_s_m * abs(velocity_m_s)


@dataclass(frozen=True, slots=True)
class BenchGauge:
    """A strain gauge: `reading = zero + sensitivity (T + curvature T^2)` with its disturbances."""

    zero: float = 0.0  # reading without tension, in its own unit
    sensitivity: float = 1.0  # units per N
    curvature_per_N: float = 0.0  # departure from a straight line, 1/N
    # Noise of one sample, N rms; 0.011 N is the reference reel's 0.04 N at 632 Hz, averaged over
    # the period of 50 Hz.
    noise_N: float = 0.011
    drift_N: float = 0.0  # drift of the zero, N rms
    drift_time_s: float = 30.0  # correlation time of the drift, s

    def reading(self, tension_N: float) -> float:
        """Reading without noise, in its own unit."""
        return self.zero + self.sensitivity * tension_N * (1.0 + self.curvature_per_N * tension_N)


@dataclass(frozen=True, slots=True)
class BenchDrive:
    """Dynamics of a reel's controllers."""

    force_lag_s: float = 0.1  # time constant of the tension controller
    force_integral_s: float = 0.6  # integral time of the tension controller
    position_lag_s: float = 0.05  # time constant of the position controller
    compliance_m_N: float = 1e-5  # displacement per change of tension, m/N
    # Force per velocity error at the cable, N s/m, under a force ramp.
    speed_damping_Ns_m: float = 200.0
    return_m_s: float = 0.005  # velocity of the return to a position, m/s
    acceleration_m_s2: float = 0.02  # acceleration to a velocity, m/s2


@dataclass(frozen=True, slots=True)
class ReelModel:
    """One reel of the bench."""

    eyelet: Eyelet = field(default_factory=Eyelet)  # friction at its eyelet
    gauge: BenchGauge = field(default_factory=BenchGauge)  # its strain gauge
    drive: BenchDrive = field(default_factory=BenchDrive)  # its controllers
    drum_radius_m: float = 0.025  # radius of the drum, m
    counts: int = 8192  # encoder counts per turn
    # Stiffness between drum and eyelet, structure, gauge and cable, N/m.
    stiffness_N_m: float = 14e3
