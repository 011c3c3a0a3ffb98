"""The parts of a rig that a model does not define itself, and the rig made of a plant."""

from dataclasses import dataclass

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import UnsafeStart
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.simulation.plant import SOFTWARE, Plant, check_above_zero, check_not_negative
from plants.simulation.simulated_rig import SimulatedRig


@dataclass(frozen=True, slots=True)
class Mounting:
    """What goes with a model that does not know it itself, to make a rig of it.

    Attributes:
        controller: The fixed part of the controller.
        profile: A step trial that suits the model.
        settling_time_s: The settling time a good tuning can reach, s.
        limits: What the rig will accept.
        noise_rms_N: Root mean square of the measurement noise, N.
        gains: Safe live gains, or None where none are known.

    Raises:
        InvalidInput: the settling time or the noise is out of its range.
    """

    controller: ControllerSettings
    profile: StepProfile
    settling_time_s: float
    limits: RigLimits
    noise_rms_N: float = 0.0
    gains: Gains | None = None

    def __post_init__(self) -> None:
        check_above_zero("settling time", self.settling_time_s, "s")
        check_not_negative("measurement noise", self.noise_rms_N, "N rms")

    def describe(
        self, name: str, gains: Gains | None, linear_model: LinearModel | None
    ) -> RigDescription:
        """What a rig with this mounting says of itself.

        Raises:
            UnsafeStart: no gains were given and no safe ones are known.
        """
        live = gains or self.gains
        if live is None:
            raise UnsafeStart(
                f"no safe gains are known for {name}; give some that hold it stable, "
                "as .rig(gains=Gains(...))"
            )
        return RigDescription(
            name=name,
            gains=live,
            controller=self.controller,
            newtons_per_ampere=1.0,
            limits=self.limits,
            step=self.profile,
            settling_time_s=self.settling_time_s,
            linear_model=linear_model,
            software=SOFTWARE,
        )


class Mounted:
    """Gives a model that carries a `Mounting` the rest of what a `Plant` is."""

    mounting: Mounting
    newtons_per_ampere = 1.0

    @property
    def controller(self) -> ControllerSettings:
        """The fixed part of the controller it is run with."""
        return self.mounting.controller

    @property
    def profile(self) -> StepProfile:
        """A step trial that suits it."""
        return self.mounting.profile

    @property
    def noise_rms_N(self) -> float:
        """Root mean square of the measurement noise, N."""
        return self.mounting.noise_rms_N


class ServesAsRig:
    """Gives a plant its `rig`."""

    def rig(
        self: Plant,
        name: str = "simulated-reel",
        seed: int = 0,
        gains: Gains | None = None,
        pace: float = 0.0,
    ) -> SimulatedRig:
        """A rig in this process that runs the plant.

        Args:
            name: The rig's name.
            seed: Seed of the measurement noise.
            gains: The live gains to begin with; None is the plant's own safe ones.
            pace: Seconds of wall-clock time that a second of a trial takes; 0 is at once.

        Raises:
            InvalidInput: the seed or the pace is out of its range.
            UnsafeStart: no gains were given and no safe ones are known.
        """
        return SimulatedRig(self, name=name, seed=seed, gains=gains, pace=pace)
