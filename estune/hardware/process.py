"""Process of the real-time loop, seen from its rig: start, requests, supervision and end."""

import contextlib
import logging
import math
import os
import subprocess
import sys
import threading
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeVar

from estune import errors
from estune.errors import EstuneError, RigError
from estune.hardware.loop_messages import BeginTrial, EndLoop, Failed, LoopPlan, Ready, Refused
from estune.hardware.shared_memory import Memory, Word, make_file

BEAT_s = 0.02
"""Period of the heartbeat from the rig to its loop."""

ANSWER_WITHIN_s = 2.0
"""Timeout of the answers to commands that move nothing."""

_START_WITHIN_s = 30.0  # compiling the controller and opening a driver included
_STALLED_s = 1.0  # a loop that stood still for so long is killed, not waited for
_POLL_s = 0.05
_LOGGED_EVERY_s = 1.0
"""Least time between two lines of the log on bad readings, of which there may be one a sample."""

_log = logging.getLogger(__name__)
_Answer = TypeVar("_Answer")


class RunningLoop(Protocol):
    """A loop as its rig sees it; see `LoopProcess`."""

    memory: Memory
    notes: tuple[str, ...]

    def check(self) -> None:
        """Checks that the loop runs."""

    def wait(self) -> None:
        """Returns when the loop has ended."""

    def request(self, command: object, kind: type[_Answer], within_s: float) -> _Answer:
        """Sends a command and waits for its answer."""

    def end(self, within_s: float) -> None:
        """Brings the reel to rest and ends the loop."""


class LoopProcess:
    """A running loop. One thread at a time may send requests; any may check it.

    Attributes:
        notes: Requests of the loop to the system that were not granted, a line each.
    """

    def __init__(self, name: str, plan: LoopPlan) -> None:
        """Starts a loop with its plan and waits until it runs.

        Raises:
            InvalidInput: a setting of the driver cannot be used.
            RigError: it does not start, or the driver does not reach its hardware.
        """
        self._name = name
        self._failure = ""
        file = make_file(plan.capacity)
        try:
            self.memory = Memory(file, plan.capacity)
            self._pipe, self.process = _start(file)
        finally:
            os.close(file)
        self._stopped = threading.Event()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        try:
            with contextlib.suppress(OSError):  # it has ended at once; its answer below says why
                self._pipe.send(plan)
            self.notes = self._await(Ready, _START_WITHIN_s).notes
        except BaseException:
            self.kill()
            raise

    def check(self) -> None:
        """Checks that the loop runs.

        Raises:
            RigError: it has ended.
        """
        if not self._failure and self.process.poll() is not None:
            code, why = self.process.returncode, self.memory.reason or "it gave no reason"
            self._failure = f"its loop has ended, exit code {code}: {why}"
        if self._failure:
            raise self._error()

    def wait(self) -> None:
        """Returns when the loop has ended, by itself or because it was asked to."""
        self.process.wait()

    def request(self, command: object, kind: type[_Answer], within_s: float) -> _Answer:
        """Sends a command and waits for its answer.

        Raises:
            RigError: it does not answer, or refuses.
            EstuneError: the loop reports a failure of this kind.
        """
        try:
            self._pipe.send(command)
        except OSError as error:
            raise self._give_up(f"its loop has ended: {error}") from error
        try:
            return self._await(kind, within_s)
        except KeyboardInterrupt:
            # Else the trial would run on, and its answer be taken for that of the next command.
            if isinstance(command, BeginTrial):
                self.memory.words[Word.ABORT] = command.number
            with contextlib.suppress(EstuneError):
                self._await(kind, ANSWER_WITHIN_s)
            raise

    def end(self, within_s: float) -> None:
        """Brings the reel to rest and ends the loop; kills it where it does not end."""
        try:
            self._pipe.send(EndLoop())
            self.process.wait(within_s)
        except (OSError, subprocess.TimeoutExpired) as error:
            why = self.memory.reason or error
            _log.error("rig %s: its loop did not end in order: %s", self._name, why)
        self.kill()

    def kill(self) -> None:
        """Ends the loop at once; the hardware's own watchdog then cuts the current."""
        self._stopped.set()
        self.process.kill()
        self.process.wait()
        self._pipe.close()

    def _await(self, kind: type[_Answer], within_s: float) -> _Answer:
        deadline = time.monotonic() + within_s
        samples, began = -1, time.monotonic()
        seen_at = began
        try:
            while not self._pipe.poll(_POLL_s):
                now = time.monotonic()
                if self.memory.words[Word.BUSY] and now - began < _START_WITHIN_s:
                    seen_at, deadline = seen_at + _POLL_s, deadline + _POLL_s
                if self.memory.words[Word.SAMPLES] != samples:
                    samples, seen_at = self.memory.words[Word.SAMPLES], now
                stalled = samples > 0 and now - seen_at > _STALLED_s
                if stalled or now > deadline:
                    fault = "has stood still" if stalled else "has not answered"
                    waited = now - seen_at if stalled else within_s
                    raise self._give_up(f"its loop {fault} for {waited:.1f} s")
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            code = self.process.wait()
            raise self._give_up(f"its loop has ended by itself, exit code {code}") from error
        if isinstance(answer, Failed):
            self._give_up(answer.sentence)
            error_class: type[EstuneError] = getattr(errors, answer.error, RigError)
            raise error_class(answer.sentence)
        if isinstance(answer, Refused):
            raise RigError(f"rig {self._name} takes no trial: {answer.reason}")
        if not isinstance(answer, kind):
            raise self._give_up(f"unexpected reply from the control loop: {answer}")
        return answer

    def _give_up(self, sentence: str) -> RigError:
        """Kills the loop: one that stood still must not continue with an old command."""
        self._failure = sentence
        self.kill()
        return self._error()

    def _error(self) -> RigError:
        return RigError(f"rig {self._name}: {self._failure}; check the rig, then start it anew")

    def _beat(self) -> None:
        words, logged, logged_s = self.memory.words, 0, -math.inf
        while not self._stopped.wait(BEAT_s):
            words[Word.BEAT] += 1
            bad, now_s = words[Word.BAD], time.monotonic()
            if bad != logged and now_s - logged_s > _LOGGED_EVERY_s:
                sentence = "rig %s: %d bad readings, the last: %s"
                _log.warning(sentence, self._name, bad - logged, self.memory.fault)
                logged, logged_s = bad, now_s


def _start(file: int) -> tuple["Connection[Any, Any]", "subprocess.Popen[bytes]"]:
    """Starts the loop's process; never by a fork, which Zenoh does not survive."""
    ours, theirs = Pipe()
    with theirs:
        process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            [sys.executable, "-m", "estune.hardware.loop", str(theirs.fileno()), str(file)],
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(), file),
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # threads, and their memory locked
            start_new_session=True,  # Ctrl-C is for us; the loop ends when we do
        )
    return ours, process
