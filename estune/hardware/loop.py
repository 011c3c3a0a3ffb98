"""The real-time loop: a process of its own, started by `estune.hardware.process`.

Its arguments are two inherited descriptors: of the pipe to the rig and of the shared memory. It
never waits for the rig. When the rig is gone, or the system asks the process to end, it brings the
reel to rest by itself.

Lateness measured at 632 Hz (median, 99 %, worst of 2000 samples) in us: plain sleep 78, 140, 3500;
timer slack of 1 ns 33, 89, 2400; with real-time priority 30, 80, 1160; with watching the clock for
the last 100 us 0, 16, 38. `time.sleep` itself waits for an absolute time on the monotonic clock
(clock_nanosleep); calling that directly was no better.
"""

import ctypes
import gc
import os
import select
import signal
import sys
import time
from contextlib import closing
from multiprocessing.connection import Connection
from typing import Any

from estune.errors import EstuneError, RigError
from estune.hardware.compensation.runtime import make_compensation
from estune.hardware.controller import make_controller
from estune.hardware.driver import load_driver
from estune.hardware.driver_link import DriverLink
from estune.hardware.hybrid_control import make_hybrid
from estune.hardware.loop_messages import (
    BeginTrial,
    Done,
    EndLoop,
    Failed,
    LoopPlan,
    Ready,
    RealTime,
    ResetEstop,
    SetCompensation,
    SetLiveGains,
)
from estune.hardware.real_time import request_priority
from estune.hardware.reel_machine.machine import ReelStateMachine
from estune.hardware.shared_memory import BINS, BIN_s, Memory, Word

_BIN_ns = BIN_s * 1e9
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2


class Loop:
    """The loop around one state machine and one driver's link."""

    def __init__(
        self,
        plan: LoopPlan,
        link: DriverLink,
        machine: ReelStateMachine,
        memory: Memory,
        rig: "Connection[Any, Any]",
    ) -> None:
        self._link = link
        self._machine = machine
        self._memory = memory
        self._rig = rig
        self._commands = select.poll()
        self._commands.register(rig.fileno(), select.POLLIN)
        self._period_ns = round(1e9 / plan.sampling_Hz)
        self._spin_ns = round(1e9 * plan.timing.spin_s)
        self._late_ns = round(1e9 * plan.timing.late_s)
        self._powered = False
        self._ending = False
        self._beat = 0
        self._beat_at_ns = time.monotonic_ns()

    def end(self, *_: object) -> None:
        """Asks the loop to end; a signal handler."""
        self._ending = True

    def run(self) -> None:
        """Runs until the rig or the system asks it to end, and the reel is at rest."""
        instant = time.monotonic_ns() + self._period_ns
        shut_down = False
        while not (shut_down and self._machine.at_rest):
            self._sample(instant)
            if self._tend_driver():
                instant = time.monotonic_ns()  # an amplifier may take its time
            self._exchange_messages()
            if self._ending and not shut_down:
                shut_down = True
                self._machine.shut_down("the rig's program has ended")
            instant = self._next_instant(instant)

    def _sample(self, instant: int) -> None:
        words = self._memory.words
        now = _wait_until(instant, self._spin_ns)
        lateness = now - instant
        late = lateness > self._late_ns
        if words[Word.BEAT] != self._beat:
            self._beat, self._beat_at_ns = words[Word.BEAT], now
        reading = self._link.read()
        silence_s = (now - self._beat_at_ns) * 1e-9
        self._link.write(self._machine.sample(reading, silence_s, late=late))
        words[Word.LATE] += late
        self._memory.lateness[min(int(lateness / _BIN_ns), BINS - 1)] += 1
        turnaround = time.monotonic_ns() - instant
        self._memory.turnaround[min(int(turnaround / _BIN_ns), BINS - 1)] += 1

    def _tend_driver(self) -> bool:
        """Switches the amplifier, or opens a driver again that is lost; whether it did either."""
        powered, lost = self._machine.powered, self._machine.at_rest and self._link.is_due
        if powered is self._powered and not lost:
            return False
        self._memory.words[Word.BUSY] = True
        if powered is not self._powered:
            self._link.switch(on=powered)
            self._powered = powered
        else:
            self._machine.remove_power()
            self._link.reopen()
            self._powered = False
        self._memory.words[Word.BUSY] = False
        return True

    def _next_instant(self, instant: int) -> int:
        """The next sampling instant; one that has passed already is skipped, not made up for."""
        instant += self._period_ns
        behind = time.monotonic_ns() - instant
        if behind < 0:
            return instant
        missed = behind // self._period_ns + 1
        self._memory.words[Word.MISSED] += missed
        return instant + missed * self._period_ns

    def _exchange_messages(self) -> None:
        """Sends the result of a trial, and takes one command."""
        machine = self._machine
        if machine.answer is not None:
            answer, machine.answer = machine.answer, None
            self._send(answer)
        if self._ending or not self._commands.poll(0):
            return
        try:
            command = self._rig.recv()
        except (EOFError, OSError):  # the rig is gone
            self._ending = True
            return
        match command:
            case BeginTrial():
                machine.begin(command)
                return
            case SetLiveGains(live):
                machine.set_live_gains(live)
            case SetCompensation():
                machine.set_compensation(command)
            case ResetEstop():
                machine.reset()
            case EndLoop():
                self._ending = True
        self._send(Done())

    def _send(self, answer: object) -> None:
        try:
            self._rig.send(answer)
        except OSError:
            self._ending = True

    def failed(self, error: Exception) -> None:
        """Leaves the hardware in its own safe state after an exception."""
        sentence = f"{type(error).__name__}: {error}"
        self._memory.reason = sentence
        self._link.make_safe()
        self._send(Failed(RigError.__name__, f"the loop has failed: {sentence}"))


def _wait_until(instant_ns: int, spin_ns: int) -> int:
    """Waits for an instant of the monotonic clock; the time then, ns."""
    now = time.monotonic_ns()
    sleep_ns = instant_ns - now - spin_ns
    if sleep_ns > 0:
        time.sleep(sleep_ns * 1e-9)
        now = time.monotonic_ns()
    while now < instant_ns:
        now = time.monotonic_ns()
    return now


def _request_real_time(timing: RealTime) -> tuple[str, ...]:
    """Requests real time for this process; what was not granted, with its remedy."""
    notes = []
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # 50 us by default, to save energy
    if timing.cpu is not None:
        try:
            os.sched_setaffinity(0, {timing.cpu})
        except OSError as error:
            notes.append(f"not bound to core {timing.cpu}: {error.strerror}")
    if refused := request_priority(timing.priority, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK):
        notes.append(refused)
    if timing.lock_memory and libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        reason = os.strerror(ctypes.get_errno())
        notes.append(
            f"memory not locked: {reason}; give the user a memlock limit, or the service "
            "LimitMEMLOCK="
        )
    return tuple(notes)


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
        with closing(DriverLink(lambda: load_driver(plan.driver, plan.driver_settings))) as link:
            controller, note = make_controller(plan.controller)
            compensation = make_compensation(plan.compensation, plan.compensation_source)
            hybrid = make_hybrid(plan.hybrid, controller, plan.controller)
            machine = ReelStateMachine(plan, memory, controller, compensation, hybrid)
            loop = Loop(plan, link, machine, memory, rig)
            signal.signal(signal.SIGTERM, loop.end)
            notes = _request_real_time(plan.timing)
            rig.send(Ready((note, *notes) if note else notes))
            gc.collect()
            gc.freeze()
            gc.disable()  # for good: a collection takes longer than a sample
            try:
                loop.run()
            except Exception as error:  # noqa: BLE001  a mistake in the loop itself ends motion
                loop.failed(error)
                return RigError.exit_code
    except EstuneError as error:
        rig.send(Failed(type(error).__name__, str(error)))
        return error.exit_code
    except Exception as error:  # noqa: BLE001  a driver is user code
        rig.send(Failed(RigError.__name__, f"{plan.driver}: {type(error).__name__}: {error}"))
        return RigError.exit_code
    return 0


if __name__ == "__main__":
    sys.path.append("")  # last: the current folder, for a user's own module:attribute
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
