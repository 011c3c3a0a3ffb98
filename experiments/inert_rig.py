"""Rigs without motion, for experiments."""

from dataclasses import replace

from estune.core.gains import Gains
from estune.trial import RigDescription, TrialRecord, TrialRequest


class MotionlessRig:
    """All of `estune.trial.Rig` but `run`, of a rig that has nothing to stop, apply or close."""

    def __init__(self, description: RigDescription) -> None:
        self._description = replace(description, simulated=True)

    def describe(self) -> RigDescription:
        """Description of the rig."""
        return self._description

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


class InertRig(MotionlessRig):
    """Answers every trial at once with the same samples; implements `estune.trial.Rig`.

    Attributes:
        requests: The trials it has run.
    """

    def __init__(self, description: RigDescription, record: TrialRecord) -> None:
        super().__init__(description)
        self.requests: list[TrialRequest] = []
        self._record = replace(record, rig=description.name)

    def run(self, request: TrialRequest) -> TrialRecord:
        """The record under the requested id, with the requested gains."""
        self.requests.append(request)
        return replace(self._record, trial_id=request.trial_id, gains=request.gains)
