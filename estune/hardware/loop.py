"""The real-time loop: a process of its own, started by `estune.hardware.rig`.

Its arguments are two descriptors it has inherited: of the pipe to the rig and of the shared
memory. It never waits for the rig. When the rig is gone, or the system asks the process to end, it
brings the reel to rest by itself.
"""

import contextlib
import select
import signal
import sys
import time
from multiprocessing.connection import Connection
from typing import Any

from estune.errors import EstuneError, RigError
from estune.hardware import realtime
from estune.hardware.controller import make_controller
from estune.hardware.driver import Driver, load_driver
from estune.hardware.loop_messages import (
    Begin,
    Done,
    End,
    Failed,
    LoopPlan,
    Ready,
    ResetEstop,
    SetLength,
    SetLiveGains,
)
from estune.hardware.reel_state_machine import ReelStateMachine
from estune.hardware.shared_memory import BINS, BIN_s, Memory, Word

_BIN_ns = BIN_s * 1e9


class Loop:
    """The loop around one machine and one driver."""

    def __init__(
        self,
        plan: LoopPlan,
        driver: Driver,
        machine: ReelStateMachine,
        memory: Memory,
        rig: "Connection[Any, Any]",
    ) -> None:
        self._driver = driver
        self._machine = machine
        self._memory = memory
        self._rig = rig
        self._waiting = select.poll()
        self._waiting.register(rig.fileno(), select.POLLIN)
        self._period_ns = round(1e9 / plan.sampling_Hz)
        self._spin_ns = round(1e9 * plan.timing.spin_s)
        self._late_ns = round(1e9 * plan.timing.late_s)
        self._powered = False
        self._ending = False
        self._beat = 0
        self._beat_at_ns = time.monotonic_ns()

    def end(self, *_: object) -> None:
        """Asks the loop to end, from a signal."""
        self._ending = True

    def run(self) -> None:
        """Runs until the rig or the system asks it to end, and the reel is at rest."""
        instant = time.monotonic_ns() + self._period_ns
        shut_down = False
        while not (shut_down and self._machine.at_rest):
            self._sample(instant)
            powered = self._machine.powered
            if powered is not self._powered:
                (self._driver.enable if powered else self._driver.disable)()
                self._powered = powered
                instant = time.monotonic_ns()  # an amplifier may take its time
            self._converse()
            if self._ending and not shut_down:
                shut_down = True
                self._machine.shut_down("the rig's program has ended")
            instant = self._following(instant)

    def _sample(self, instant: int) -> None:
        words = self._memory.words
        now = realtime.wait_until(instant, self._spin_ns)
        lateness = now - instant
        late = lateness > self._late_ns
        if words[Word.BEAT] != self._beat:
            self._beat, self._beat_at_ns = words[Word.BEAT], now
        reading = self._driver.read()
        silence = (now - self._beat_at_ns) * 1e-9
        self._driver.write(self._machine.sample(reading, silence, late=late))
        words[Word.LATE] += late
        self._memory.lateness[min(int(lateness / _BIN_ns), BINS - 1)] += 1
        took = time.monotonic_ns() - instant
        self._memory.turnaround[min(int(took / _BIN_ns), BINS - 1)] += 1

    def _following(self, instant: int) -> int:
        """The next sampling instant; one that has passed already is missed, not made up for."""
        instant += self._period_ns
        behind = time.monotonic_ns() - instant
        if behind < 0:
            return instant
        missed = behind // self._period_ns + 1
        self._memory.words[Word.MISSED] += missed
        return instant + missed * self._period_ns

    def _converse(self) -> None:
        """Sends what has become of a trial, and takes one command."""
        machine = self._machine
        if machine.answer is not None:
            answer, machine.answer = machine.answer, None
            self._send(answer)
        if self._ending or not self._waiting.poll(0):
            return
        try:
            command = self._rig.recv()
        except (EOFError, OSError):  # the rig is gone
            self._ending = True
            return
        match command:
            case Begin():
                machine.begin(command)
                return
            case SetLiveGains(live):
                machine.swap(live)
            case SetLength(length_m):
                machine.tell(length_m)
            case ResetEstop():
                machine.clear()
            case End():
                self._ending = True
        self._send(Done())

    def _send(self, answer: object) -> None:
        try:
            self._rig.send(answer)
        except OSError:
            self._ending = True

    def failed(self, error: Exception) -> None:
        """The driver, or we, have failed: the hardware is left to itself."""
        sentence = f"{type(error).__name__}: {error}"
        self._memory.reason = sentence
        for last_resort in (self._driver.safe_state, self._driver.disable):
            with contextlib.suppress(Exception):
                last_resort()
        self._send(Failed(RigError.__name__, f"the loop has failed: {sentence}"))


def main(pipe: int, block: int) -> int:
    """Runs a loop to its end.

    Returns:
        The exit code: 0 where it was asked to end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the rig, which ends us in order
    rig: Connection[Any, Any] = Connection(pipe)
    plan: LoopPlan = rig.recv()
    memory = Memory(block, plan.capacity)
    try:
        with load_driver(plan.driver, plan.driver_settings) as driver:
            controller, note = make_controller(plan.controller)
            loop = Loop(plan, driver, ReelStateMachine(plan, memory, controller), memory, rig)
            signal.signal(signal.SIGTERM, loop.end)
            notes = realtime.prepare(plan.timing)
            rig.send(Ready((note, *notes) if note else notes))
            realtime.stop_collecting()
            try:
                loop.run()
            except Exception as error:  # noqa: BLE001  whatever a driver raises ends motion
                loop.failed(error)
                return RigError.exit_code
    except EstuneError as error:
        rig.send(Failed(type(error).__name__, str(error)))
        return error.exit_code
    except Exception as error:  # noqa: BLE001  a driver is anybody's code
        rig.send(Failed(RigError.__name__, f"{plan.driver}: {type(error).__name__}: {error}"))
        return RigError.exit_code
    return 0


if __name__ == "__main__":
    sys.path.append("")  # where a user's own module:attribute is looked for, at last
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
