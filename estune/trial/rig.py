"""The rig: anything that answers a trial request with a trial record."""

from typing import Protocol, runtime_checkable

from estune.core.gains import Gains
from estune.trial.description import RigDescription
from estune.trial.records import Telemetry, TrialRecord, TrialRequest


class Rig(Protocol):
    """Anything that answers a trial request with a trial record.

    A trial is a guest: its gains are swapped in, and the live gains are back when `run` returns or
    raises. Failure of a trial is data, an outcome in the record; an exception means that the rig
    could not be asked.
    """

    def describe(self) -> RigDescription:
        """What the rig is, and which gains are live now."""
        ...

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: the rig cannot be reached, or knows another trial by that id.
        """
        ...

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones. The only way the live gains ever change."""
        ...

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        ...

    def estop(self, reason: str) -> None:
        """Begins to bring the rig to its safe state, whatever it does, and returns at once.

        The trial under way, if any, ends. The rig stays there, and refuses trials and gains with a
        `RigError`, until it is cleared. May be called by any thread, any number of times.
        """
        ...

    def clear(self) -> None:
        """Ends an emergency stop: the rig may be used again. Nothing moves by it."""
        ...

    def close(self) -> None:
        """Lets go of the rig; further calls are refused."""
        ...


@runtime_checkable
class TelemetrySource(Protocol):
    """A rig that shows a trial while it runs."""

    def telemetry(self, after: int) -> Telemetry | None:
        """The samples of the trial under way from index `after` on; None if none is.

        They are a copy. May be called by any thread, often, and must not slow the trial.
        """
        ...
