"""The rig: anything that answers a trial request with a trial record."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from estune.core.gains import Gains
from estune.trial.description import RigDescription
from estune.trial.records import Telemetry, TrialRecord, TrialRequest


class Rig(Protocol):
    """Anything that answers a trial request with a trial record.

    A trial uses temporary gains: the live gains are restored when `run` returns or raises. A
    failed trial is an outcome in its record; an exception means that the rig did not accept it.
    Every method raises `RigError` where the rig is closed, gone, stopped or held by others.
    """

    def describe(self) -> RigDescription:
        """Its description, with its live gains."""
        ...

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: it knows another trial by that id, or keeps the record no longer.
        """
        ...

    def apply(self, gains: Gains) -> None:
        """Changes the live gains, without a jump of the effort; nothing else does.

        Raises:
            InvalidInput: they are outside the rig's bounds.
        """
        ...

    def abort(self) -> RigDescription:
        """Stops the running trial, if any, and returns once the live gains are restored."""
        ...

    def estop(self, reason: str) -> None:
        """Begins to bring the rig to its safe state, and returns at once.

        A running trial ends. The rig stays in its safe state, and refuses trials and gains with a
        `RigError`, until `clear`. Any thread may call, any number of times.
        """
        ...

    def clear(self) -> None:
        """Resets the emergency stop; nothing moves."""
        ...

    def close(self) -> None:
        """Closes the rig; further calls are refused."""
        ...


@runtime_checkable
class TelemetrySource(Protocol):
    """A rig with telemetry of the running trial."""

    def telemetry(self, after: int) -> Telemetry | None:
        """A copy of the running trial's samples from index `after` on; None without a trial.

        Any thread may call, often; the trial must not be delayed.
        """
        ...


@runtime_checkable
class CompensatedRig(Protocol):
    """A rig with compensations of its own beside the controller."""

    def switch_off(self, tables: Sequence[str]) -> None:
        """Switches compensations off, without a jump of the effort, until the rig's next start.

        Args:
            tables: Their tables in `[compensation]` of the rig's file.

        Raises:
            InvalidInput: one of them is not on; nothing is changed.
        """
        ...
