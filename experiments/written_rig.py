"""Rigs whose loop an experiment simulates by itself: what they have in common."""

from abc import ABC, abstractmethod

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.trial import Outcome, RigDescription, RigLimits, TrialRecord, TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.records import record_of


class WrittenRig(ABC):
    """A rig that tells nothing of its model.

    Args:
        name: Its name.
        start: Its live gains.
        controller: The fixed part of its controller.
        limits: What it allows; a trial ends as diverged where the measurement leaves its range.
        step: Its step trial.
        settling_time_s: Of its loop.

    Attributes:
        trials: Number of trials run.
    """

    def __init__(
        self,
        *,
        name: str,
        start: Gains,
        controller: ControllerSettings,
        limits: RigLimits,
        step: StepProfile,
        settling_time_s: float,
    ) -> None:
        self.trials = 0
        self._description = RigDescription(
            name=name,
            gains=start,
            controller=controller,
            newtons_per_ampere=1.0,
            limits=limits,
            step=step,
            settling_time_s=settling_time_s,
            simulated=True,
            measurement="measurement",
            command="control effort",
        )

    @abstractmethod
    def answer(self, request: TrialRequest, setpoint: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort, which end with the first measurement out of range."""

    def describe(self) -> RigDescription:
        """Its description."""
        return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        """One trial."""
        rate = self._description.controller.sampling_Hz
        setpoint = request.profile.setpoint(rate)
        self.trials += 1
        measured, effort = self.answer(request, setpoint)
        count = measured.size
        ended = count < setpoint.size
        return record_of(
            *(request, self._description, Outcome.DIVERGED if ended else Outcome.DONE),
            *("the measurement left its range" if ended else "", "2006-01-01T00:00:00+00:00"),
            time_s=np.arange(count) / rate,
            setpoint_N=setpoint[:count],
            tension_N=measured,
            current_A=effort,
            angle_rad=np.zeros(count),
            flags=np.zeros(count, np.uint8),
        )

    def apply(self, gains: Gains) -> None:  # noqa: B027  as it is for all
        """Nothing: no tuning calls it."""

    def close(self) -> None:  # noqa: B027  as it is for all
        """Nothing is open."""
