"""The step of an FMU, executed in a process of its own: an FMU is native code, and may crash."""

import os
import struct
import subprocess
import sys
import threading
import weakref
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from estune.errors import InvalidInput, PlantError

ANSWER_WITHIN_S = 20.0
"""Longest time of one step, and of loading the unit."""

REQUEST = struct.Struct("<dd")
"""Effort and time step, s; a step of zero resets the unit."""
ANSWER = struct.Struct("<Bd")
"""1 if it worked, and the measurement; where it did not, the reason follows as text."""


class FmuFacts(NamedTuple):
    """Description of an FMU by itself.

    Attributes:
        version: `2.0` or `3.0`.
        tool: Program that made it.
        extra_step: Whether its outputs are one communication step late: Simulink's are, but for
            FMI 3 with events (MathWorks, "Export Simulink Model to Functional Mock-up Unit").
        initial: The output at the start.
    """

    version: str
    tool: str
    extra_step: bool
    initial: float


@dataclass(frozen=True)
class FmuStep:
    """Step function of an FMU for `plants.python_plant`; the state is the time, s.

    Each thread has a process of its own, started when it is first used.

    Attributes:
        file: The `.fmu` file.
        input: Name of the variable that takes the effort.
    """

    file: str
    input: str
    output: str
    _local: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    def __getstate__(self) -> dict[str, str]:
        return {"file": self.file, "input": self.input, "output": self.output}

    def __setstate__(self, state: dict[str, str]) -> None:
        for name, value in {**state, "_local": threading.local()}.items():
            object.__setattr__(self, name, value)

    def __call__(self, time_s: float, effort: float, dt_s: float) -> tuple[float, float]:
        """Advances the unit; at time 0 it begins anew.

        Raises:
            PlantError: the unit fails.
        """
        child = self._child()
        if time_s == 0.0:
            child.exchange(REQUEST.pack(0.0, 0.0))
        return time_s + dt_s, child.exchange(REQUEST.pack(effort, dt_s))

    def facts(self) -> FmuFacts:
        """The unit's description of itself.

        Raises:
            InvalidInput: it cannot be used: no co-simulation, no such variable, no library for
                this machine, or FMPy is not installed.
        """
        return self._child().facts

    def _child(self) -> "_Child":
        child: _Child | None = getattr(self._local, "child", None)
        if child is None or child.ended:
            child = self._local.child = _Child(self.file, self.input, self.output)
        return child


class _Child:
    """The process of one instance."""

    def __init__(self, file: str, input_: str, output: str) -> None:
        ours, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  our own interpreter and module
                [sys.executable, "-m", "plants.models.fmu.process", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        self._pipe = ours
        self.ended = False
        self.end = weakref.finalize(self, _end, self._process, ours)
        self._file = file
        ours.send((file, input_, output))
        answer = self._receive(ours.recv)
        if isinstance(answer, str):
            self._fail()
            raise InvalidInput(f"{file}: {answer}")
        self.facts: FmuFacts = answer

    def exchange(self, request: bytes) -> float:
        """Executes one step; the measurement after it."""
        try:
            self._pipe.send_bytes(request)
        except OSError as error:
            raise self._broken() from error
        answer = self._receive(self._pipe.recv_bytes)
        good, value = ANSWER.unpack_from(answer)
        if not good:
            reason = answer[ANSWER.size :].decode()
            raise PlantError(f"{self._file}: {reason}; check the model in its own tool")
        return float(value)

    def _receive(self, receive: Any) -> Any:
        try:
            if self._pipe.poll(ANSWER_WITHIN_S):
                return receive()
        except (EOFError, OSError) as error:
            raise self._broken() from error
        self._fail()
        raise PlantError(
            f"{self._file}: no answer for {ANSWER_WITHIN_S:g} s; check the model in its own tool"
        )

    def _broken(self) -> PlantError:
        code = self._process.wait(ANSWER_WITHIN_S)
        self._fail()
        return PlantError(
            f"{self._file}: the unit ended its process, exit code {code}; check the model in its "
            "own tool"
        )

    def _fail(self) -> None:
        self.ended = True
        self.end()


def _end(process: "subprocess.Popen[bytes]", pipe: "Connection[Any, Any]") -> None:
    pipe.close()
    process.kill()
    process.wait()
