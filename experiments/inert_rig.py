"""A rig without motion, and an example of a record and of a description."""

from dataclasses import replace

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.trial import Outcome, RigDescription, RigLimits, TrialRecord, TrialRequest
from estune.trial.profiles import StepProfile

GAINS = Gains(0.5, 20.0, 0.002, 0.01)
STEP = StepProfile(15.0, 5.0, 0.1, 1.0)
REQUEST = TrialRequest("monday", 7, GAINS, STEP)
RECORD = TrialRecord(
    trial_id=REQUEST.trial_id,
    rig="reel",
    sampling_Hz=632.0,
    cable_length_m=0.8,
    preload_N=15.0,
    gains=GAINS,
    outcome=Outcome.GUARD,
    reason="tension above 45 N",
    started_at="2009-05-04T12:00:00.000+02:00",
    software="board 1.0",
    time_s=np.array([0.0, 1.0 / 632.0]),
    setpoint_N=np.array([15.0, 15.0]),
    tension_N=np.array([14.75, 45.5]),
    current_A=np.array([0.75, -6.0]),
    angle_rad=np.array([0.0, 0.25]),
    flags=np.array([0, 3], np.uint8),
)
DESCRIBED = RigDescription(
    name="reel",
    gains=GAINS,
    controller=ControllerSettings(632.0, 0.001, -120.0, 120.0),
    newtons_per_ampere=20.0,
    limits=RigLimits(2.0, 45.0, 10.0),
    step=STEP,
    settling_time_s=0.25,
    cable_length_m=0.8,
    software="board 1.0",
)


class InertRig:
    """Answers every trial at once with the same samples; implements `estune.trial.Rig`.

    Attributes:
        requests: The trials it has run.
    """

    def __init__(self, description: RigDescription, record: TrialRecord) -> None:
        self._description = replace(description, simulated=True)
        self.requests: list[TrialRequest] = []
        self._record = replace(record, rig=description.name)

    def describe(self) -> RigDescription:
        """Description of the rig."""
        return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        """The record under the requested id, with the requested gains."""
        self.requests.append(request)
        return replace(self._record, trial_id=request.trial_id, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Does nothing: there are no live gains."""

    def abort(self) -> RigDescription:
        """Description of the rig: no trial runs between calls."""
        return self._description

    def estop(self, reason: str) -> None:
        """Does nothing: nothing moves."""

    def clear(self) -> None:
        """Does nothing: nothing was stopped."""

    def close(self) -> None:
        """Does nothing: nothing is open."""
