"""A motorised cable reel whose far cable end is fixed: its physical parameters."""

import math
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.effects.plant_scale import PlantScale
from plants.models.path_structure import squarings_for
from plants.models.plant_model import (
    PlantModel,
    changed_fields,
    check_field_names,
    check_fields,
)
from plants.models.reel_equations import ReelStructure, drum_stiffness_Nm_rad, viscous_friction_Nms
from plants.simulation.plant import SOFTWARE

SAFE_GAINS = Gains(P=0.4, I=12.0, D=0.01, setpoint_filter_s=0.03)
"""Deliberately mediocre: stable with large margins over the reel's lengths and tensions."""

_MAY_BE_ZERO = (
    "viscous_friction_Nms",
    "viscous_friction_per_length_Ns",
    "cable_density_kg_m",
    "gauge_damping",
    "gauge_noise_N",
    "dead_time_s",
    "derivative_filter_s",
)


@dataclass(frozen=True, repr=False)
class Reel(PlantModel):
    """A reel at one cable length and tension; equations in `plants.models.reel_equations`.

    Attributes:
        cable_length_m: Deployed length L, m.
        tension_N: Preload of the suggested step, N.
        drum_radius_m: Radius R of the cable on the drum, m.
        drum_inertia_kg_m2: Inertia of motor and drum, referred to the drum, kg m2.
        viscous_friction_Nms: Viscous friction without cable, N m s/rad.
        viscous_friction_per_length_Ns: Viscous friction per metre of cable, N m s/rad per m.
        structure_stiffness_N_m: Stiffness of the structure and the gauge, N/m.
        cable_EA_N: Young's modulus times cross-section of the cable, N.
        cable_density_kg_m: Mass per length of the cable, kg/m; the default is a 3 mm fibre line.
        torque_constant_Nm_A: Torque at the drum per motor current, N m/A.
        current_limit_A: Maximum magnitude of the motor current, A.
        dead_time_s: Dead time from command to torque, s.
        gauge_Hz: Natural frequency of the gauge, Hz.
        gauge_damping: Damping ratio of the gauge.
        gauge_noise_N: Noise of the gauge, N rms.
        encoder_counts: Encoder counts per turn of the drum.
        sampling_Hz: Sampling rate of the controller, Hz.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        tension_min_N: Minimum setpoint, N.
        tension_max_N: Maximum setpoint, N.
    """

    cable_length_m: float
    tension_N: float
    drum_radius_m: float = 0.025
    drum_inertia_kg_m2: float = 2.0e-3
    viscous_friction_Nms: float = 0.010
    viscous_friction_per_length_Ns: float = 0.015
    structure_stiffness_N_m: float = 20e3
    cable_EA_N: float = 10e3
    cable_density_kg_m: float = 0.007
    torque_constant_Nm_A: float = 0.5
    current_limit_A: float = 6.0
    dead_time_s: float = 1.0 / 632.0
    gauge_Hz: float = 290.0
    gauge_damping: float = 0.03
    gauge_noise_N: float = 0.04
    encoder_counts: float = 4.0 * 2048.0
    sampling_Hz: float = 632.0
    derivative_filter_s: float = 0.002
    tension_min_N: float = 5.0
    tension_max_N: float = 40.0

    diagnosed_by = "plants.diagnosis.models.reel:DiagnosedReel"
    uncertain = (
        "drum_inertia_kg_m2",
        "viscous_friction_Nms",
        "viscous_friction_per_length_Ns",
        "cable_EA_N",
        "structure_stiffness_N_m",
    )

    def __post_init__(self) -> None:
        check_fields(self, "reel", _MAY_BE_ZERO)
        if not self.tension_min_N <= self.tension_N <= self.tension_max_N:
            raise InvalidInput(
                f"reel: tension is {self.tension_N:g} N; it must lie from "
                f"{self.tension_min_N:g} to {self.tension_max_N:g} N"
            )
        if not self.gauge_damping < 1.0:
            raise InvalidInput(
                f"reel: gauge_damping is {self.gauge_damping:g}; a mode has less than 1"
            )
        if self.tension_max_N > self.current_limit_A * self.newtons_per_ampere:
            raise InvalidInput(
                f"reel: {self.current_limit_A:g} A hold no more than "
                f"{self.current_limit_A * self.newtons_per_ampere:g} N, and tension_max_N is "
                f"{self.tension_max_N:g} N"
            )

    @property
    def newtons_per_ampere(self) -> float:
        """Tension at rest per motor current, N/A."""
        return self.torque_constant_Nm_A / self.drum_radius_m

    @property
    def scale(self) -> PlantScale:
        softness = 1.0 / self.structure_stiffness_N_m + self.cable_length_m / self.cable_EA_N
        return PlantScale(
            subject="reel",
            radius_m=self.drum_radius_m,
            length_m=self.cable_length_m,
            tension_N=self.tension_N,
            stiffness_N_m=1.0 / softness,
            newtons_per_ampere=self.newtons_per_ampere,
            sampling_Hz=self.sampling_Hz,
            dead_time_s=self.dead_time_s,
        )

    @property
    def noise_rms_N(self) -> float:
        """Noise of the gauge, N rms."""
        return self.gauge_noise_N

    @cached_property
    def controller(self) -> ControllerSettings:
        """Controller whose limits are those of the current."""
        limit = self.current_limit_A * self.newtons_per_ampere
        return ControllerSettings(self.sampling_Hz, self.derivative_filter_s, -limit, limit)

    @cached_property
    def profile(self) -> StepProfile:
        """A step of 10 N at 0.2 s in a trial of 1 s; downward near the maximum tension."""
        room = self.tension_max_N - self.tension_N
        return StepProfile(self.tension_N, 10.0 if room >= 10.0 else -10.0, 0.2, 1.0)

    @property
    def natural_frequency_rad_s(self) -> float:
        """Natural frequency omega_n of drum and cable at the preload, rad/s."""
        return math.sqrt(drum_stiffness_Nm_rad(self, self.tension_N) / self.drum_inertia_kg_m2)

    def linear_model(self) -> LinearModel:
        """Linear model from effort to gauge reading at the preload, without the effects."""
        kappa = drum_stiffness_Nm_rad(self, self.tension_N)
        J, b = self.drum_inertia_kg_m2, viscous_friction_Nms(self)
        w = 2.0 * math.pi * self.gauge_Hz
        return LinearModel(
            A=(
                (0.0, 1.0, 0.0, 0.0),
                (-kappa / J, -b / J, 0.0, 0.0),
                (0.0, 0.0, 0.0, 1.0),
                (w**2 * kappa / self.drum_radius_m, 0.0, -(w**2), -2.0 * self.gauge_damping * w),
            ),
            B=(0.0, self.drum_radius_m / J, 0.0, 0.0),
            C=(0.0, 0.0, 1.0, 0.0),
            dead_time_s=self.dead_time_s,
        )

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        return RigDescription(
            name=name,
            gains=gains or SAFE_GAINS,
            controller=self.controller,
            newtons_per_ampere=self.newtons_per_ampere,
            limits=RigLimits(self.tension_min_N, self.tension_max_N, duration_max_s=60.0),
            step=self.profile,
            settling_time_s=2.0 * math.pi / self.natural_frequency_rad_s,
            cable_length_m=self.cable_length_m,
            linear_model=self.linear_model(),
            software=SOFTWARE,
        )

    @property
    def own_numbers(self) -> dict[str, float]:
        return {name: getattr(self, name) for name in ReelStructure.OWN}

    def summary(self) -> str:
        """Length, tension, and the fields that differ from their defaults."""
        return changed_fields(self, always=("cable_length_m", "tension_N"))

    @cached_property
    def structure(self) -> ReelStructure:
        p = self.amended_numbers
        amended = {n for e in self.effects for n in e.amend(SimpleNamespace(**vars(e)), p)}
        kappa = drum_stiffness_Nm_rad(p, self.tension_max_N)
        J, b = p.drum_inertia_kg_m2, viscous_friction_Nms(p)
        fastest = max(2.0 * math.pi * p.gauge_Hz, math.sqrt(kappa / J), b / J)
        return ReelStructure(
            effects=self.kinds,
            # A dead time that an effect may change is whole by chance only.
            fractional=self.dead_time[1] > 0.0 or "dead_time_s" in amended,
            squarings=squarings_for(fastest, self.sampling_Hz),
        )


def reference_reel(cable_length_m: float = 0.8, tension_N: float = 15.0, **overrides: Any) -> Reel:
    """The reel of the examples: plausible numbers, not those of any one machine.

    >>> reference_reel(tension_N=20.0)
    Reel(cable_length_m=0.8, tension_N=20)

    Args:
        cable_length_m: Deployed length, 0.5 to 1.4 m in the examples.
        tension_N: Preload, 5 to 40 N.
        **overrides: Any other attribute of `Reel`.
    """
    check_field_names(Reel, "a reel", overrides)
    return Reel(cable_length_m, tension_N, **overrides)
