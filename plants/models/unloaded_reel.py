"""A reel without its cable: torque in, angle out, no tension."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import PlantError
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.effects.plant_scale import PlantScale
from plants.models.effect_applicability import unavailable
from plants.models.linear_structures import DrumStructure
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.path_structure import squarings_for
from plants.models.plant_model import (
    PlantModel,
    changed_fields,
    check_field_names,
    check_fields,
)
from plants.simulation.plant import SOFTWARE, TrialSetpoint

_MAY_BE_ZERO = ("viscous_friction_Nms", "dead_time_s", "derivative_filter_s")

_NUMBERS = (*DrumStructure.own, *LinearEffectStructure.COMMON)

STEP_SHARE = 0.1
"""Size of the suggested step relative to the force at the maximum current."""


@dataclass(frozen=True, repr=False)
class UnloadedReel(PlantModel):
    """A motor and a drum without a cable: `J theta'' + b theta' = Kt i`.

    Servos and positioning stages, `plants.models.drives`, have the same equations.

    There is no tension to control: its trials run in open loop, and setpoint x radius is the
    commanded torque.

    Attributes:
        drum_radius_m: Radius R that converts torque to force, m.
        drum_inertia_kg_m2: Inertia J of motor and drum, kg m2.
        viscous_friction_Nms: Viscous friction b, N m s/rad.
        torque_constant_Nm_A: Torque at the drum per motor current Kt, N m/A.
        current_limit_A: Maximum magnitude of the motor current, A.
        dead_time_s: Dead time from command to torque, s.
        encoder_counts: Encoder counts per 2 pi of the angle.
        sampling_Hz: Sampling rate.
        derivative_filter_s: Time constant of the controller's derivative filter, s.

    Raises:
        InvalidInput: a value is out of its range.
        PlantError: an effect cannot be added.
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

    title: ClassVar[str] = "unloaded reel"
    uncertain = ("drum_inertia_kg_m2", "viscous_friction_Nms")
    noise_rms_N: ClassVar[float] = 0.0
    diagnosed_by = "plants.diagnosis.models.unloaded:DiagnosedDrum"

    def __post_init__(self) -> None:
        check_fields(self, self.title, _MAY_BE_ZERO)
        for effect in self.effects:
            reason = unavailable(DrumStructure(), type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to the {self.title}: {reason}")

    @property
    def scale(self) -> PlantScale:
        return PlantScale(
            subject="drive",
            radius_m=self.drum_radius_m,
            newtons_per_ampere=self.newtons_per_ampere,
            sampling_Hz=self.sampling_Hz,
        )

    @property
    def newtons_per_ampere(self) -> float:
        """Force at the radius per motor current, N/A."""
        return self.torque_constant_Nm_A / self.drum_radius_m

    @property
    def force_limit_N(self) -> float:
        """Force at the maximum current, N."""
        return self.current_limit_A * self.newtons_per_ampere

    @property
    def limits(self) -> RigLimits:
        """Limits of its trials: a drum without a cable may turn as it likes."""
        return RigLimits(-self.force_limit_N, self.force_limit_N, duration_max_s=60.0)

    @cached_property
    def controller(self) -> ControllerSettings:
        """Controller whose limits are those of the current."""
        limit = self.force_limit_N
        return ControllerSettings(self.sampling_Hz, self.derivative_filter_s, -limit, limit)

    @cached_property
    def profile(self) -> StepProfile:
        """An open-loop step from rest to a tenth of the force limit, in a trial of 1 s."""
        return StepProfile(0.0, STEP_SHARE * self.force_limit_N, 0.2, 1.0, loop="open")

    def linear_model(self) -> LinearModel:
        """Linear model from effort to angle in rad, without the effects."""
        J, b = self.drum_inertia_kg_m2, self.viscous_friction_Nms
        return LinearModel(
            A=((0.0, 1.0), (0.0, -b / J)),
            B=(0.0, self.drum_radius_m / J),
            C=(1.0, 0.0),
            dead_time_s=self.dead_time_s,
        )

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        return RigDescription(
            name=name,
            gains=gains or Gains(1.0, 0.0, 0.0, 0.0),  # its trials run without a controller
            controller=self.controller,
            newtons_per_ampere=self.newtons_per_ampere,
            limits=self.limits,
            step=self.profile,
            settling_time_s=self.profile.duration_s,
            linear_model=self.linear_model(),
            software=SOFTWARE,
        )

    @property
    def own_numbers(self) -> dict[str, float]:
        units = {"torque_unit": 1.0, "angle_unit": 1.0}
        return {n: units[n] if n in units else getattr(self, n) for n in _NUMBERS}

    def summary(self) -> str:
        """The fields that differ from their defaults."""
        return changed_fields(self)

    @cached_property
    def structure(self) -> LinearEffectStructure:
        p = self.amended_numbers
        fastest = p.viscous_friction_Nms / p.drum_inertia_kg_m2
        return LinearEffectStructure(
            base=DrumStructure(),
            effects=self.kinds,
            fractional=True,
            squarings=squarings_for(max(fastest, 1e-9), self.sampling_Hz),
        )

    def admissible(self, drive: TrialSetpoint) -> TrialSetpoint:
        """An open-loop trial from rest at an angle of zero."""
        if not drive.open_loop:
            raise PlantError(
                f"the {self.title} has no tension to control; ask for a trial in open loop"
            )
        return drive._replace(preload_N=0.0)


def unloaded_reel(**overrides: Any) -> UnloadedReel:
    """The reference reel without its cable.

    Args:
        **overrides: Any attribute of `UnloadedReel`.
    """
    check_field_names(UnloadedReel, "an unloaded reel", overrides)
    return UnloadedReel(**overrides)
