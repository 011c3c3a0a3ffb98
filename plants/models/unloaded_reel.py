"""A reel without its cable: torque in, angle out, no tension."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, PlantError
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.models.effect_applicability import unavailable
from plants.models.effect_mixin import EffectMixin
from plants.models.linear_structures import Drum
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.mounting import ServesAsRig
from plants.models.reel_equations import ReelStructure
from plants.simulation.plant import SOFTWARE, Columns, Drive, check_above_zero, check_not_negative
from plants.simulation.trial_loop import Batch, trial_loop

_MAY_BE_ZERO = ("viscous_friction_Nms", "dead_time_s", "derivative_filter_s")

_NUMBERS = (*Drum.own, *LinearEffectStructure.COMMON)

SHARE_OF_LIMIT = 0.1
"""Size of the suggested step, relative to the force that the greatest current gives."""


@dataclass(frozen=True)
class UnloadedReel(EffectMixin, ServesAsRig):
    """A motor and a drum that no cable holds: `J theta'' + b theta' = Kt i`.

    Equally a servo or a positioning stage: with a radius of 1, a mass for the inertia and a torque
    constant of 1 the command is a force in N and the angle a position in m.

    It has no tension to be controlled, so that its trials run in open loop: setpoint x radius is
    the torque commanded.

    Attributes:
        drum_radius_m: Radius R, which makes a force of a torque, m.
        drum_inertia_kg_m2: Inertia J of motor and drum, kg m2.
        viscous_friction_Nms: Viscous friction b, N m s/rad.
        torque_constant_Nm_A: Torque at the drum per motor current Kt, N m/A.
        current_limit_A: Greatest size of the motor current, A.
        dead_time_s: From the command to the torque, s.
        encoder_counts: Steps of the encoder per 2 pi of the angle.
        sampling_Hz: Sampling rate.
        derivative_filter_s: Time constant of the controller's derivative filter, s.

    Raises:
        InvalidInput: a value is out of its range.
        PlantError: an effect needs a cable.
    """

    drum_radius_m: float = 0.025
    drum_inertia_kg_m2: float = 2.0e-3
    viscous_friction_Nms: float = 0.010
    torque_constant_Nm_A: float = 0.5
    current_limit_A: float = 6.0
    dead_time_s: float = 1.0 / 632.0
    encoder_counts: float = 4.0 * 2048.0
    sampling_Hz: float = 632.0
    derivative_filter_s: float = 0.002

    noise_rms_N: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name in _MAY_BE_ZERO:
                check_not_negative(f"unloaded reel: {f.name}", getattr(self, f.name), "")
            elif f.name != "effects":
                check_above_zero(f"unloaded reel: {f.name}", getattr(self, f.name), "")
        for effect in self.effects:
            reason = unavailable(Drum(), type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to an unloaded reel: {reason}")

    @property
    def newtons_per_ampere(self) -> float:
        """Force at the radius per motor current, N/A."""
        return self.torque_constant_Nm_A / self.drum_radius_m

    @property
    def force_limit_N(self) -> float:
        """Force that the greatest current gives, N."""
        return self.current_limit_A * self.newtons_per_ampere

    @cached_property
    def controller(self) -> ControllerSettings:
        """The controller's limits are those of the current."""
        limit = self.force_limit_N
        return ControllerSettings(self.sampling_Hz, self.derivative_filter_s, -limit, limit)

    @cached_property
    def profile(self) -> StepProfile:
        """A push of a tenth of the greatest force, from rest, in a trial of a second."""
        return StepProfile(0.0, SHARE_OF_LIMIT * self.force_limit_N, 0.2, 1.0, loop="open")

    def linear_model(self) -> LinearModel:
        """Effort to angle in rad, without the effects."""
        J, b = self.drum_inertia_kg_m2, self.viscous_friction_Nms
        return LinearModel(
            A=((0.0, 1.0), (0.0, -b / J)),
            B=(0.0, self.drum_radius_m / J),
            C=(1.0, 0.0),
            dead_time_s=self.dead_time_s,
        )

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        """What a rig that runs this drum says of itself."""
        limit = self.force_limit_N
        return RigDescription(
            name=name,
            gains=gains or Gains(1.0, 0.0, 0.0, 0.0),  # no trial of it runs a controller
            controller=self.controller,
            newtons_per_ampere=self.newtons_per_ampere,
            limits=RigLimits(-limit, limit, duration_max_s=60.0),
            step=self.profile,
            settling_time_s=self.profile.duration_s,
            linear_model=self.linear_model(),
            software=SOFTWARE,
        )

    @property
    def own_numbers(self) -> dict[str, float]:
        """The drum's numbers by name, as the equations take them."""
        units = {"torque_unit": 1.0, "angle_unit": 1.0}
        named = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: named[name] for name in named if name in _NUMBERS} | units

    @cached_property
    def structure(self) -> LinearEffectStructure:
        """What the equations depend on besides numbers."""
        p = self.amended
        fastest = p.viscous_friction_Nms / p.drum_inertia_kg_m2
        return LinearEffectStructure(
            base=Drum(),
            effects=self.kinds,
            fractional=True,
            squarings=ReelStructure.squarings_for(max(fastest, 1e-9), self.sampling_Hz),
        )

    @cached_property
    def parameter_values(self) -> FloatArray:
        """The numbers the equations take, in the order of `LinearEffectStructure.parameter_names`."""
        return self.numbers(self.own_numbers[name] for name in self.structure.own_names)

    def respond(
        self,
        coefficients: FloatArray,
        drive: Drive,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of open-loop trials from rest at an angle of zero; see `Plant.respond`.

        Raises:
            PlantError: a closed loop was asked for.
        """
        if not drive.open_loop:
            raise PlantError(
                "an unloaded reel has no tension to control; ask for a trial in open loop"
            )
        batch = Batch(
            parameters=self.parameter_values,
            coefficients=coefficients,
            preload_N=0.0,
            setpoint_N=drive.setpoint_N,
            noise_N=noise_N,
            delay=self.delay_samples,
            bound_N=bound_N,
            open_loop=True,
        )
        return trial_loop(self.structure).run(batch)


def unloaded_reel(**overrides: Any) -> UnloadedReel:
    """The reference reel with its cable taken off.

    Args:
        **overrides: Any attribute of `UnloadedReel`.

    Raises:
        InvalidInput: a value is out of its range, or there is no such attribute.
    """
    known = {f.name for f in fields(UnloadedReel)}
    for name in overrides:
        if name not in known:
            raise InvalidInput(
                f"an unloaded reel has no {name}; it has {', '.join(sorted(known))}"
            )
    return UnloadedReel(**overrides)
