"""A rig's own log of what it did: written as it happens, read by who wants to count.

Each line is one JSON object on standard output, a pipe that no full disk reaches and that outlives
the process that wrote to it.
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

What = Literal["boot", "begin", "end", "apply"]


class Motion(NamedTuple):
    """One line of the log.

    Attributes:
        at_s: When, on the clock all processes share (`time.monotonic`).
        rig: The process that says so.
        what: `boot`: ready to be asked; `begin` and `end` of a trial; `apply` of gains.
        trial_id: The trial, if any.
        live: The gains that are live after it.
    """

    at_s: float
    rig: int
    what: What
    trial_id: str
    live: tuple[float, ...]


def say(what: What, trial_id: str, live: Gains) -> None:
    """Writes a line of the log; returns once it would survive the process."""
    line = json.dumps((time.monotonic(), os.getpid(), what, trial_id, live.as_tuple()))
    os.write(sys.stdout.fileno(), f"{line}\n".encode())


class Log:
    """The lines of all rigs, in the order they were read. Any thread may look."""

    def __init__(self) -> None:
        self._motions: list[Motion] = []
        self._news = threading.Condition()

    def follow(self, stream: IO[bytes]) -> threading.Thread:
        """Reads a rig's log by a thread, until the rig ends."""
        thread = threading.Thread(target=self._read, args=(stream,), daemon=True)
        thread.start()
        return thread

    def motions(self) -> tuple[Motion, ...]:
        """All there is so far."""
        with self._news:
            return tuple(self._motions)

    def count(self, what: What) -> int:
        """How many there are of a kind."""
        return sum(motion.what == what for motion in self.motions())

    def wait(self, enough: Callable[[tuple[Motion, ...]], bool], timeout_s: float) -> bool:
        """Waits until the log holds enough; whether it came to that."""
        with self._news:
            return self._news.wait_for(lambda: enough(tuple(self._motions)), timeout_s)

    def _read(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                at_s, rig, what, trial_id, live = json.loads(line)
                with self._news:
                    self._motions.append(Motion(at_s, rig, what, trial_id, tuple(live)))
                    self._news.notify_all()


class LoggedRig:
    """Any rig, with a log of its motions; implements `estune.trial.Rig`.

    It never tells a trial that it ran from one that it did not: whatever it is asked to run, it
    runs and logs. A simulated one is passed off as one that moves, and takes the gains of a trial
    for its live ones while it lasts, as a machine does.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._live = rig.describe().gains
        self._runs = 0

    def boot(self) -> None:
        """Logs that it is ready."""
        say("boot", "", self._live)

    def describe(self) -> RigDescription:
        """What the rig is, with the gains that are live on it at this moment."""
        return replace(self._rig.describe(), gains=self._live, simulated=False)

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial, whether or not it has run before."""
        before, self._runs = self._live, self._runs + 1
        say("begin", request.trial_id, before)
        self._live = request.gains
        try:
            record = self._rig.run(replace(request, run=f"motion{self._runs}"))
        finally:
            self._live = before
            say("end", request.trial_id, self._live)
        return replace(record, trial_id=request.trial_id)

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones."""
        self._rig.apply(gains)
        self._live = gains
        say("apply", "", gains)

    def abort(self) -> RigDescription:
        """Stops the trial under way."""
        self._rig.abort()
        return self.describe()

    def estop(self, reason: str) -> None:
        """Brings the rig to its safe state."""
        self._rig.estop(reason)

    def clear(self) -> None:
        """Ends an emergency stop."""
        self._rig.clear()

    def telemetry(self, after: int) -> Telemetry | None:
        """The samples of the trial under way, if the rig shows any."""
        rig: Any = self._rig
        shown: Telemetry | None = (
            rig.telemetry(after) if isinstance(rig, TelemetrySource) else None
        )
        return shown

    def close(self) -> None:
        """Lets go of the rig."""
        self._rig.close()
