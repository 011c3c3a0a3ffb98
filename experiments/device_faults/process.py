"""An emulated device with faults as a process, and the handle of the campaign on it.

    python -m experiments.device_faults.process serial|can ADDRESS

It prints where a driver reaches it, executes lines of standard input (`begin MESSAGES FAULT`,
`end`, `truth`), answers each by a line, and ends when that is closed.
"""

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import plants
from estune.hardware.real_time import request_priority
from estune.support.child_process import child_process, next_line
from experiments.device_faults.devices import FAULTY, FaultyCan, FaultySerial
from plants.emulator.board import Electronics, EmulatedBoard

_PRIORITY = 60
WATCHDOG_s = 0.1


class DeviceProcess:
    """The device's process.

    Attributes:
        address: Where a driver reaches it.
    """

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.address = next_line(process)

    def begin(self, fault: str, messages: int) -> None:
        """Begins a fault, of so many messages or, for none, until it is ended."""
        self._ask(f"begin {messages} {fault}")

    def end(self) -> None:
        """Ends the fault."""
        self._ask("end")

    def has_current(self) -> bool:
        """Whether the motor has a current."""
        return bool(json.loads(self._ask("truth")))

    def _ask(self, line: str) -> str:
        assert self._process.stdin is not None  # noqa: S101  a pipe
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return next_line(self._process)


@contextmanager
def device_process(kind: str, address: str) -> Iterator[DeviceProcess]:
    """An emulated device for the duration of the block."""
    with child_process("experiments.device_faults.process", kind, address) as process:
        yield DeviceProcess(process)


def main(kind: str, address: str) -> int:
    """Serves a device until standard input is closed; returns the exit code."""
    request_priority(_PRIORITY, os.SCHED_FIFO)
    electronics = Electronics(watchdog_s=WATCHDOG_s)
    board = EmulatedBoard(plants.reference_reel(), electronics, 1, time.monotonic())
    device: FaultySerial | FaultyCan = FAULTY[kind](board, address)
    print(device.address, flush=True)
    while True:
        lines_from = sys.stdin.fileno()
        ready, _, _ = select.select([*device.readable, lines_from], [], [], 0.005)
        board.advance(time.monotonic())
        for file in ready:
            if file != lines_from:
                with suppress(OSError):  # unplugged by the line before
                    device.take(file, time.monotonic())
                continue
            lines = os.read(lines_from, 4096).decode()
            if not lines:
                return 0
            print(_execute(device, board, lines.strip()), flush=True)
        device.tick(time.monotonic())


def _execute(device: FaultySerial | FaultyCan, board: EmulatedBoard, line: str) -> str:
    verb, *rest = line.split(" ", 2)
    if verb == "begin":
        device.begin(rest[1], int(rest[0]))
    elif verb == "end":
        device.end()
    else:
        return json.dumps(board.truth(time.monotonic()).current_A != 0.0)
    return "done"


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
