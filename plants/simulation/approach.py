"""A plant whose trials begin as those of a rig do: with the setpoint back from that of another."""

from dataclasses import dataclass

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile
from plants.simulation.plant import Columns, Plant, TrialSetpoint


@dataclass(frozen=True, slots=True)
class Approach:
    """How a rig comes to the preload of a closed-loop trial.

    For half of the time the setpoint moves to the preload at a constant rate, then it stays there.

    Attributes:
        from_N: Setpoint before it, relative to the preload, N.
        duration_s: Time from there to the first sample of the trial, s.
    """

    from_N: float = 0.0
    duration_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ApproachedPlant:
    """The plant with an approach before each trial, by the trial's own gains; see `Plant`.

    What a drum with dry friction holds when a trial begins depends on where it came from: a trial
    that begins settled, with no friction held, costs 3.86 where one that comes from the end of the
    trial before costs 4.29 on a reel with 0.03 N m of friction.
    """

    plant: Plant
    approach: Approach

    @property
    def controller(self) -> ControllerSettings:
        return self.plant.controller

    @property
    def profile(self) -> StepProfile:
        return self.plant.profile

    @property
    def noise_rms_N(self) -> float:
        return self.plant.noise_rms_N

    @property
    def newtons_per_ampere(self) -> float:
        return self.plant.newtons_per_ampere

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        return self.plant.describe(name, gains)

    def respond(
        self,
        coefficients: FloatArray,
        drive: TrialSetpoint,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of trials; the noise before a trial is its own, mirrored."""
        lead = round(self.approach.duration_s * self.controller.sampling_Hz)
        if drive.open_loop or lead == 0:
            return self.plant.respond(coefficients, drive, noise_N, bound_N)
        part = np.minimum(np.arange(lead) / (0.5 * lead), 1.0)
        setpoint = drive.preload_N + self.approach.from_N * (1.0 - part)
        whole = drive._replace(
            time_s=np.arange(lead + drive.time_s.size) / self.controller.sampling_Hz,
            setpoint_N=np.concatenate([setpoint, drive.setpoint_N]),
            preload_N=float(setpoint[0]),
            load_N=None if drive.load_N is None else np.pad(drive.load_N, (lead, 0)),
        )
        noise = None if noise_N is None else np.pad(noise_N, ((0, 0), (lead, 0)), "symmetric")

        found = self.plant.respond(coefficients, whole, noise, bound_N)
        trial = (slice(None), slice(lead, None))
        return found._replace(
            tension_N=found.tension_N[trial],
            effort_N=found.effort_N[trial],
            angle_rad=found.angle_rad[trial],
            flags=found.flags[trial],
            ended=np.maximum(found.ended - lead, 0),
            reference_N=None if found.reference_N is None else found.reference_N[trial],
            terms=None if found.terms is None else found.terms[trial],
        )
