"""A rig's log of its motions: written as they happen, read by the verdict.

Each line is one JSON object on standard output, a pipe that is independent of full disks and
outlives the process that wrote to it.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import IO, Any, Literal, NamedTuple

from estune.core.gains import Gains
from estune.trial import Rig, RigDescription, Telemetry, TelemetrySource, TrialRecord, TrialRequest

Kind = Literal["boot", "begin", "end", "apply"]


class LoggedMotion(NamedTuple):
    """One line of the log.

    Attributes:
        at_s: Time on the clock that all processes share (`time.monotonic`).
        rig: Process id of the rig.
        what: `boot`: ready for queries; `begin` and `end` of a trial; `apply` of gains.
        trial_id: The trial, if any.
        live: The live gains after it.
    """

    at_s: float
    rig: int
    what: Kind
    trial_id: str
    live: tuple[float, ...]


def write(what: Kind, trial_id: str, live: Gains) -> None:
    """Writes a line of the log; returns once it would survive the process."""
    line = json.dumps((time.monotonic(), os.getpid(), what, trial_id, live.as_tuple()))
    os.write(sys.stdout.fileno(), f"{line}\n".encode())


class Log:
    """The lines of all rigs, in the order of reading. Any thread may call."""

    def __init__(self) -> None:
        self._motions: list[LoggedMotion] = []
        self._changed = threading.Condition()

    def follow(self, stream: IO[bytes]) -> None:
        """Reads a rig's log by a thread, until the rig ends."""
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def motions(self) -> tuple[LoggedMotion, ...]:
        """All lines so far."""
        with self._changed:
            return tuple(self._motions)

    def count(self, what: Kind) -> int:
        """Number of lines of a kind."""
        return sum(motion.what == what for motion in self.motions())

    def wait(
        self, condition: Callable[[tuple[LoggedMotion, ...]], bool], timeout_s: float
    ) -> bool:
        """Waits for a condition on the lines; returns whether it holds."""
        with self._changed:
            return self._changed.wait_for(lambda: condition(tuple(self._motions)), timeout_s)

    def _read(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                at_s, rig, what, trial_id, live = json.loads(line)
                with self._changed:
                    self._motions.append(LoggedMotion(at_s, rig, what, trial_id, tuple(live)))
                    self._changed.notify_all()


class LoggedRig:
    """Any rig, with a log of its motions; implements `estune.trial.Rig`.

    It has no memory of trials: it runs and logs every request. A simulated rig appears as one that
    moves, and shows the gains of a trial as its live ones during it, as a machine does.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._live = rig.describe().gains
        self._runs = 0
        self.estop, self.clear, self.close = rig.estop, rig.clear, rig.close

    def boot(self) -> None:
        """Logs that it is ready."""
        write("boot", "", self._live)

    def describe(self) -> RigDescription:
        """Properties of the rig, with the gains that are live at this moment."""
        return replace(self._rig.describe(), gains=self._live, simulated=False)

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial, whether or not it has run before."""
        before, self._runs = self._live, self._runs + 1
        write("begin", request.trial_id, before)
        self._live = request.gains
        try:
            record = self._rig.run(replace(request, run=f"motion{self._runs}"))
        finally:
            self._live = before
            write("end", request.trial_id, self._live)
        return replace(record, trial_id=request.trial_id)

    def apply(self, gains: Gains) -> None:
        """Sets the live gains."""
        self._rig.apply(gains)
        self._live = gains
        write("apply", "", gains)

    def abort(self) -> RigDescription:
        """Stops the active trial."""
        self._rig.abort()
        return self.describe()

    def telemetry(self, after: int) -> Telemetry | None:
        """Samples of the active trial, if the rig provides them."""
        rig: Any = self._rig
        samples: Telemetry | None = (
            rig.telemetry(after) if isinstance(rig, TelemetrySource) else None
        )
        return samples
