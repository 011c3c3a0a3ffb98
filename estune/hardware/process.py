"""The process of the real-time loop, as its rig sees it: started, asked, watched and given up."""

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from estune import errors
from estune.errors import EstuneError, RigError
from estune.hardware.loop_messages import End, Failed, LoopPlan, Ready, Refused
from estune.hardware.shared_memory import Memory, Word, make_file

BEAT_s = 0.02
"""How often the rig gives its loop a sign of life."""

ANSWER_WITHIN_s = 2.0
"""How long the loop may take to answer what moves nothing."""

_START_WITHIN_s = 30.0
_STALLED_s = 1.0
_POLL_s = 0.05

_log = logging.getLogger(__name__)
_Answer = TypeVar("_Answer")


class LoopProcess:
    """A loop that runs. One thread at a time asks it; any may look whether it is alive.

    Attributes:
        memory: What it shares with its rig.
        process: The process.
        notes: What it asked the system for and did not get, a line each.
    """

    def __init__(self, name: str, plan: LoopPlan) -> None:
        """Starts a loop, tells it its plan and waits until it runs.

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
        self._beating = threading.Event()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        try:
            with contextlib.suppress(OSError):  # it has ended at once; it says why below
                self._pipe.send(plan)
            self.notes = self._await(Ready, _START_WITHIN_s).notes
        except BaseException:
            self.kill()
            raise

    def check(self) -> None:
        """Makes sure that it runs.

        Raises:
            RigError: it has ended.
        """
        if not self._failure and self.process.poll() is not None:
            code, why = self.process.returncode, self.memory.reason or "it has not said why"
            self._failure = f"its loop has ended, exit code {code}: {why}"
        if self._failure:
            raise self._error()

    def ask(self, command: object, kind: type[_Answer], within_s: float) -> _Answer:
        """Has it do something.

        Raises:
            RigError: it does not answer, or refuses.
            EstuneError: it failed, by its own account.
        """
        try:
            self._pipe.send(command)
        except OSError as error:
            raise self._given_up(f"its loop has ended: {error}") from error
        return self._await(kind, within_s)

    def end(self, within_s: float) -> None:
        """Has it bring the reel to rest and end; killed where it does not."""
        try:
            self._pipe.send(End())
            self.process.wait(within_s)
        except (OSError, subprocess.TimeoutExpired) as error:
            why = self.memory.reason or error
            _log.error("rig %s: its loop did not end in order: %s", self._name, why)
        self.kill()

    def kill(self) -> None:
        """Ends it at once: what is left to the hardware is its own watchdog."""
        self._beating.set()
        self.process.kill()
        self.process.wait()
        self._pipe.close()

    def _await(self, kind: type[_Answer], within_s: float) -> _Answer:
        """What it answers."""
        deadline = time.monotonic() + within_s
        samples, seen_at = -1, time.monotonic()
        try:
            while not self._pipe.poll(_POLL_s):
                now = time.monotonic()
                if self.memory.words[Word.SAMPLES] != samples:
                    samples, seen_at = self.memory.words[Word.SAMPLES], now
                stalled = samples > 0 and now - seen_at > _STALLED_s
                if stalled or now > deadline:
                    doing = "has stood still" if stalled else "has not answered"
                    waited = now - seen_at if stalled else within_s
                    raise self._given_up(f"its loop {doing} for {waited:.1f} s")
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            code = self.process.wait()
            raise self._given_up(f"its loop has ended by itself, exit code {code}") from error
        if isinstance(answer, Failed):
            self._given_up(answer.sentence)
            raise _named(answer)
        if isinstance(answer, Refused):
            raise RigError(f"rig {self._name} takes no trial: {answer.sentence}")
        if not isinstance(answer, kind):
            raise self._given_up(f"its loop has answered out of turn: {answer}")
        return answer

    def _given_up(self, sentence: str) -> RigError:
        """Gives it up for good.

        A loop that has merely stood still must not come to life again with an old command.
        """
        self._failure = sentence
        self.kill()
        return self._error()

    def _error(self) -> RigError:
        return RigError(f"rig {self._name}: {self._failure}; look at it, then start it anew")

    def _beat(self) -> None:
        words = self.memory.words
        while not self._beating.wait(BEAT_s):
            words[Word.BEAT] += 1


def _start(file: int) -> tuple["Connection[Any, Any]", "subprocess.Popen[bytes]"]:
    """Starts the loop's process: never by a fork, for Zenoh does not survive one."""
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


def _named(failed: Failed) -> EstuneError:
    kind = getattr(errors, failed.error, RigError)
    made: EstuneError = kind(failed.sentence)
    return made
