"""A motorised cable reel whose far cable end is fixed: its physical parameters."""

import math
from dataclasses import dataclass, fields
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.models.effect_mixin import EffectMixin
from plants.models.mounting import ServesAsRig
from plants.models.reel_equations import ReelStructure, drum_stiffness_Nm_rad, viscous_friction_Nms
from plants.simulation.plant import SOFTWARE, Columns, Drive, check_above_zero, check_not_negative
from plants.simulation.trial_loop import Batch, trial_loop

SAFE_GAINS = Gains(P=0.4, I=12.0, D=0.01, setpoint_filter_s=0.03)
"""Deliberately mediocre: stable with room to spare over the lengths and tensions of the reel."""

_MAY_BE_ZERO = (
    "viscous_friction_Nms",
    "viscous_friction_per_length_Ns",
    "cable_density_kg_m",
    "gauge_damping",
    "gauge_noise_N",
    "dead_time_s",
    "derivative_filter_s",
)


@dataclass(frozen=True)
class Reel(EffectMixin, ServesAsRig):
    """A reel at one cable length and tension; the equations are in `plants.models.reel_equations`.

    Attributes:
        cable_length_m: Deployed length L, m.
        tension_N: Preload of the suggested step, N.
        drum_radius_m: Radius R on which the cable lies, m.
        drum_inertia_kg_m2: Inertia of motor and drum, seen at the drum, kg m2.
        viscous_friction_Nms: Viscous friction without cable, N m s/rad.
        viscous_friction_per_length_Ns: What each metre of cable adds to it, N m s/rad per m.
        structure_stiffness_N_m: Stiffness of the structure and the gauge, N/m.
        cable_EA_N: Young's modulus times section of the cable, N.
        cable_density_kg_m: Mass of the cable per length, kg/m; about that of a 3 mm fibre line.
        torque_constant_Nm_A: Torque at the drum per motor current, N m/A.
        current_limit_A: Greatest size of the motor current, A.
        dead_time_s: From the command to the torque, s.
        gauge_Hz: Natural frequency of the gauge, Hz.
        gauge_damping: Damping ratio of the gauge.
        gauge_noise_N: Noise of the gauge, N rms.
        encoder_counts: Steps of the encoder per turn of the drum.
        sampling_Hz: Rate at which the controller runs, Hz.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        tension_min_N: Least setpoint, N.
        tension_max_N: Greatest setpoint, N.

    Raises:
        InvalidInput: a value is out of its range.
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

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name in _MAY_BE_ZERO:
                check_not_negative(f"reel: {f.name}", getattr(self, f.name), "")
            elif f.name != "effects":
                check_above_zero(f"reel: {f.name}", getattr(self, f.name), "")
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
    def noise_rms_N(self) -> float:
        """Noise of the gauge, N rms."""
        return self.gauge_noise_N

    @cached_property
    def controller(self) -> ControllerSettings:
        """The controller's limits are those of the current."""
        limit = self.current_limit_A * self.newtons_per_ampere
        return ControllerSettings(self.sampling_Hz, self.derivative_filter_s, -limit, limit)

    @cached_property
    def profile(self) -> StepProfile:
        """A step of 10 N at 0.2 s in a trial of 1 s, downward where the range ends above."""
        room = self.tension_max_N - self.tension_N
        return StepProfile(self.tension_N, 10.0 if room >= 10.0 else -10.0, 0.2, 1.0)

    @property
    def natural_frequency_rad_s(self) -> float:
        """omega_n of drum and cable at the preload, rad/s."""
        return math.sqrt(drum_stiffness_Nm_rad(self, self.tension_N) / self.drum_inertia_kg_m2)

    def linear_model(self) -> LinearModel:
        """Effort to gauge reading about the preload, without the effects."""
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
        """What a rig that runs this reel says of itself."""
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
        """The reel's own numbers by name, as the equations take them."""
        return {name: getattr(self, name) for name in ReelStructure.OWN}

    @property
    def _moved(self) -> set[str]:
        """Which of the reel's own numbers the effects may change."""
        p = self.amended
        return {name for e in self.effects for name in e.amend(SimpleNamespace(**vars(e)), p)}

    @cached_property
    def structure(self) -> ReelStructure:
        """What the equations depend on besides numbers."""
        p = self.amended
        kappa = drum_stiffness_Nm_rad(p, self.tension_max_N)
        J, b = p.drum_inertia_kg_m2, viscous_friction_Nms(p)
        fastest = max(2.0 * math.pi * p.gauge_Hz, math.sqrt(kappa / J), b / J)
        return ReelStructure(
            effects=self.kinds,
            # A dead time that an effect may move is whole by chance only.
            fractional=self.dead_time[1] > 0.0 or "dead_time_s" in self._moved,
            squarings=ReelStructure.squarings_for(fastest, self.sampling_Hz),
        )

    @cached_property
    def parameter_values(self) -> FloatArray:
        """The numbers the equations take, in the order of `ReelStructure.parameter_names`."""
        return self.numbers(self.own_numbers.values())

    def respond(
        self,
        coefficients: FloatArray,
        drive: Drive,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of trials; see `Plant.respond`."""
        batch = Batch(
            parameters=self.parameter_values,
            coefficients=coefficients,
            preload_N=drive.preload_N,
            setpoint_N=drive.setpoint_N,
            noise_N=noise_N,
            delay=self.delay_samples,
            bound_N=bound_N,
            open_loop=drive.open_loop,
        )
        return trial_loop(self.structure).run(batch)


def reference_reel(cable_length_m: float = 0.8, tension_N: float = 15.0, **overrides: Any) -> Reel:
    """The reel of the examples: plausible numbers, not those of any one machine.

    Args:
        cable_length_m: Deployed length, 0.5 to 1.4 m in the examples.
        tension_N: Preload, 5 to 40 N.
        **overrides: Any other attribute of `ReelProgress`.

    Raises:
        InvalidInput: a value is out of its range, or there is no such attribute.
    """
    known = {f.name for f in fields(Reel)}
    for name in overrides:
        if name not in known:
            raise InvalidInput(f"a reel has no {name}; it has {', '.join(sorted(known))}")
    return Reel(cable_length_m, tension_N, **overrides)
