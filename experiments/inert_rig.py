"""A simulated rig without motion, for experiments on the link."""

from dataclasses import replace

from estune.core.gains import Gains
from estune.trial import RigDescription, TrialRecord, TrialRequest


class InertRig:
    """Answers every trial at once with the same samples; implements `estune.trial.Rig`.

    Attributes:
        requests: The trials it has run.
    """

    def __init__(self, description: RigDescription, record: TrialRecord) -> None:
        self.requests: list[TrialRequest] = []
        self._description = replace(description, simulated=True)
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
        """Description of the rig: no trial is ever active."""
        return self._description

    def estop(self, reason: str) -> None:
        """Does nothing: nothing moves."""

    def clear(self) -> None:
        """Does nothing: nothing was stopped."""

    def close(self) -> None:
        """Does nothing: nothing is open."""
