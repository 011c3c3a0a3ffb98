"""The parts of a rig that a model does not define itself."""

from dataclasses import dataclass

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import check_not_negative, check_positive
from estune.errors import UnsafeStart
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.description import UNLIMITED_N
from estune.trial.profiles import StepProfile
from estune.trial.signals import Signals
from plants.effects.plant_scale import PlantScale
from plants.models.plant_model import PlantModel
from plants.simulation.plant import SOFTWARE

HOW_TO_GIVE_GAINS = (
    "in the file of a linear plant or an FMU as "
    "gains = { P = ..., I = ..., D = ..., setpoint_filter_s = ... }, "
    "in Python as start=Gains(...) of estune.tune, or gains=Gains(...) of the plant or its .rig"
)
"""Remedy in messages on a plant without safe gains."""

SETTLING_TIMES_AFTER_STEP = 5.0
TRIAL_MAX_samples = 1_000_000


@dataclass(frozen=True, slots=True)
class Mounting:
    """Settings that turn a bare model into a rig."""

    controller: ControllerSettings  # the fixed part of the controller
    profile: StepProfile  # A step trial that suits the model
    settling_time_s: float  # the settling time a good tuning can reach, s
    limits: RigLimits  # limits of the rig
    noise_rms_N: float = 0.0  # root mean square of the measurement noise, N
    gains: Gains | None = None  # safe live gains, or None where none are known
    newtons_per_ampere: float = 1.0  # effort per motor current, N/A
    measurement: str = "measurement"  # what is measured, with its unit: "speed, rad/s"
    command: str = "control effort"  # what is commanded, likewise: "voltage, V"

    def __post_init__(self) -> None:
        check_positive("settling time", self.settling_time_s, "s")
        check_not_negative("measurement noise", self.noise_rms_N, "N rms")
        check_positive("effort per ampere", self.newtons_per_ampere, "N/A")

    def describe(
        self, name: str, gains: Gains | None, linear_model: LinearModel | None
    ) -> RigDescription:
        """Description of a rig with this mounting.

        Raises:
            UnsafeStart: no gains were given and no safe ones are known.
        """
        live = gains or self.gains
        if live is None:
            raise UnsafeStart(
                f"no safe gains are known for {name}; give some that hold it stable, "
                f"{HOW_TO_GIVE_GAINS}"
            )
        return RigDescription(
            name=name,
            gains=live,
            controller=self.controller,
            newtons_per_ampere=self.newtons_per_ampere,
            limits=self.limits,
            step=self.profile,
            settling_time_s=self.settling_time_s,
            linear_model=linear_model,
            software=SOFTWARE,
            measurement=self.measurement,
            command=self.command,
        )


def unit_step(preload_N: float, settling_time_s: float) -> StepProfile:
    """A step of one, followed for five settling times, of a plant that comes without a profile."""
    after_s = SETTLING_TIMES_AFTER_STEP * settling_time_s
    return StepProfile(preload_N, 1.0, 0.5 * settling_time_s, 0.5 * settling_time_s + after_s)


def wide_limits(sampling_Hz: float) -> RigLimits:
    """Limits that are practically none, of a plant that comes without any."""
    return RigLimits(-UNLIMITED_N, UNLIMITED_N, TRIAL_MAX_samples / sampling_Hz)


@dataclass(frozen=True, repr=False)
class MountedModel(PlantModel):
    """A plant model that carries a `Mounting`, in units of its own."""

    mounting: Mounting  # controller, suggested step, limits and noise

    rig_name = "simulated-plant"

    @property
    def signals(self) -> Signals:
        return Signals(self.mounting.measurement, self.mounting.command)

    @property
    def scale(self) -> PlantScale:
        signals = self.signals
        return super().scale._replace(
            input_unit=signals.command_unit,
            output_unit=signals.measurement_unit,
            channels={
                "tension_N": (signals.measurement_name, signals.measurement_unit),
                "current_A": (signals.command_name, signals.command_unit),
            },
        )

    @property
    def newtons_per_ampere(self) -> float:
        return self.mounting.newtons_per_ampere

    @property
    def controller(self) -> ControllerSettings:
        return self.mounting.controller

    @property
    def profile(self) -> StepProfile:
        return self.mounting.profile

    @property
    def noise_rms_N(self) -> float:
        return self.mounting.noise_rms_N
