"""Emulated devices whose answers pass through faults, as a process of its own.

    python -m experiments.chaos.faulty_devices serial|can ADDRESS

It prints where a driver reaches it, takes names of faults as lines of standard input, and ends
when that is closed.
"""

import os
import select
import struct
import sys
import time
from typing import Any

import plants
from estune.hardware.real_time import request_priority
from plants.emulator.board import Electronics, EmulatedBoard
from plants.emulator.devices import NODE, CanDevices, SerialDevice

_PRIORITY = 60
SILENT_S = {"silent for 30 ms": 0.03, "silent for 0.3 s": 0.3, "silent for 1 s": 1.0}
DEAF = "deaf to commands for 0.3 s"
HEARTBEATS = "no heartbeats for 1 s"
AXIS = "the axis reports an error"
ANSWERS = {
    "an answer lost": ["lost"],
    "two answers lost": ["lost"] * 2,
    "an answer doubled": ["twice"],
}
KINDS: dict[str, tuple[str, ...]] = {
    "serial": (
        *(*ANSWERS, *SILENT_S, DEAF, "an answer cut off", "an answer damaged"),
        "noise before an answer",
    ),
    "can": (*ANSWERS, *SILENT_S, DEAF, HEARTBEATS, AXIS, "a frame of another node"),
}
"""Faults of each device."""


class Line:
    """What becomes of the answers of a device.

    Attributes:
        silent_until_s: No answer before it.
        deaf_until_s: No command of an effort is obeyed before it.
        mute_until_s: No heartbeat before it.
    """

    def __init__(self) -> None:
        self.silent_until_s = self.deaf_until_s = self.mute_until_s = 0.0
        self._next: list[str] = []

    def fault(self, name: str) -> None:
        """Begins a fault."""
        now_s = time.monotonic()
        if name in SILENT_S:
            self.silent_until_s = now_s + SILENT_S[name]
        elif name == DEAF:
            self.deaf_until_s = now_s + 0.3
        elif name == HEARTBEATS:
            self.mute_until_s = now_s + 1.0
        else:
            self._next += ANSWERS.get(name, [name])

    def pass_on(self, packet: bytes, foreign: bytes) -> list[bytes]:
        """The packets that arrive in place of one."""
        if time.monotonic() < self.silent_until_s:
            return []
        fault = self._next.pop(0) if self._next else ""
        parts = {
            "lost": [],
            "twice": [packet, packet],
            "an answer cut off": [packet[:11]],
            "an answer damaged": [packet[:9] + bytes([packet[-1] ^ 4]) + packet[10:]],
            "noise before an answer": [foreign, packet],
            "a frame of another node": [foreign, packet],
        }
        return parts.get(fault, [packet])


class FaultySerial(SerialDevice):
    """The serial board on a line with faults."""

    def __init__(self, board: EmulatedBoard, address: str) -> None:
        super().__init__(board, address)
        self.line = Line()

    def send(self, packet: bytes) -> None:
        """Sends what is left of an answer."""
        for part in self.line.pass_on(packet, b"\x5a\x01garbage"):
            super().send(part)

    def _execute(self, verb: bytes, sequence: int, number: int, now_s: float) -> None:
        if verb != b"w" or now_s >= self.line.deaf_until_s:
            super()._execute(verb, sequence, number, now_s)


class FaultyCan(CanDevices):
    """The ODrive and the gauge on a bus with faults."""

    def __init__(self, board: EmulatedBoard, address: str) -> None:
        super().__init__(board, address)
        self.line = Line()

    def fail(self) -> None:
        """The axis leaves closed loop with an error, as at an overcurrent."""
        self._estop(b"", time.monotonic())

    def _send(self, identifier: int, data: bytes) -> None:
        now_s = time.monotonic()
        if identifier == (NODE << 5) | 0x01:
            if now_s >= self.line.mute_until_s:
                super()._send(identifier, data)
            return
        for part in self.line.pass_on(data, struct.pack("<ff", 9.0, 0.0)):
            super()._send(identifier if part is data else (5 << 5) | 0x09, part)

    def _torque(self, data: bytes, now_s: float) -> None:
        if now_s >= self.line.deaf_until_s:
            super()._torque(data, now_s)


def main(kind: str, address: str) -> int:
    """Serves the devices until standard input is closed; returns the exit code."""
    request_priority(_PRIORITY, os.SCHED_FIFO)
    electronics = Electronics(watchdog_s=0.5)
    board = EmulatedBoard(plants.reference_reel(), electronics, 1, time.monotonic())
    device: Any = {"serial": FaultySerial, "can": FaultyCan}[kind](board, address)
    print(device.address, flush=True)
    while True:
        ready, _, _ = select.select([*device.readable, sys.stdin], [], [], 0.005)
        board.advance(time.monotonic())
        for file in ready:
            if file is not sys.stdin:
                device.take(file, time.monotonic())
                continue
            names = os.read(sys.stdin.fileno(), 4096).decode().split("\n")
            if names == [""]:
                return 0
            for name in filter(None, names):
                device.fail() if name == AXIS else device.line.fault(name)
        device.tick(time.monotonic())


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
