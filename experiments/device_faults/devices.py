"""Emulated devices that misbehave when told to, as the suite of drivers asks for."""

import binascii
import os
import struct
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Generic, TypeVar

from estune.conformance.driver import FAULTS
from plants.emulator.board import EmulatedBoard
from plants.emulator.devices import GAUGE, NODE, CanDevices, SerialDevice

RESTART_s = 0.1
"""Time for which a device that was reset is silent."""
_FLOOD = 40
"""Messages of a flood at every request: ten times what a line at its usual rate carries."""


Message = TypeVar("Message")
Forms = Mapping[str, Callable[[int], list[Message]]]
"""By fault, what becomes of a message, from its number within the fault."""


class Line(Generic[Message]):
    """What becomes of the messages of a device.

    Attributes:
        fault: The fault under way; empty without any.
        silent_until_s: No message before it.
    """

    def __init__(self) -> None:
        self.fault = ""
        self.silent_until_s = 0.0
        self._left = self._number = 0
        self._before: dict[int, Message] = {}

    def begin(self, fault: str, messages: int) -> None:
        """Begins a fault, of so many messages or, for none, until it is ended."""
        self.fault, self._left, self._number = fault, messages, 0

    def end(self) -> None:
        """Ends the fault."""
        self.fault = ""

    def spoiled(self, kind: int, message: Message, forms: "Forms[Message]") -> list[Message]:
        """The messages in place of one of a kind."""
        if self.fault == "silence" or time.monotonic() < self.silent_until_s:
            return []
        fault, number = self.fault, self._number
        before = [self._before[kind]] if kind in self._before else []
        self._before[kind] = message
        if self._left and number + 1 == self._left:
            self.fault = ""
        self._number += 1
        common = {
            "duplicate": [message, message],
            "stale": [*before, message],
            "out of order": before,
        }
        if fault in forms:
            return forms[fault](number)
        return common.get(fault, [message])


_ANSWER = struct.Struct("<BBHHIii")
_STATUS, _SEQUENCE, _ACCEPTED, _TIME, _GAUGE, _ENCODER = range(1, 7)


def sealed(fields: list[int]) -> bytes:
    """An answer of the board with its checksum."""
    packet = _ANSWER.pack(*fields)
    return packet + struct.pack("<H", binascii.crc_hqx(packet, 0xFFFF))


class FaultySerial(SerialDevice):
    """The serial board on a line with faults; the port's name stays when it is plugged in again.

    Attributes:
        line: The line.
        faults: Faults that it can have.
    """

    faults = (*(f for f in FAULTS if f != "infinity"), "deaf", "power lost", "noise")

    def __init__(self, board: EmulatedBoard, address: str) -> None:
        super().__init__(board, address)
        self.line: Line[bytes] = Line()
        self._zero = 0
        self._port = Path(f"{address}.tty")
        self._port.symlink_to(self.address)
        self.address = str(self._port)

    @property
    def readable(self) -> list[int]:
        """The near end, while the board is plugged in."""
        return super().readable if self._port.is_symlink() else []

    def begin(self, fault: str, messages: int = 0) -> None:
        """Begins a fault."""
        self.line.begin(fault, messages)
        if fault == "reset":
            self._board.power(time.monotonic(), on=False)
            self._accepted = 0
            self._zero = self._board.read(time.monotonic())[1]
            self.line.silent_until_s = time.monotonic() + RESTART_s
        elif fault == "power lost":
            self._board.power(time.monotonic(), on=False)
        elif fault == "unplugged":
            self._port.unlink()
            os.close(self._file)
            os.close(self._far)

    def end(self) -> None:
        """Ends the fault."""
        if self.line.fault == "unplugged":
            SerialDevice.__init__(self, self._board, "")
            self._port.symlink_to(self.address)
            self.address = str(self._port)
        self.line.end()

    def _execute(self, verb: bytes, sequence: int, number: int, now_s: float) -> None:
        if not (self.line.fault == "deaf" and verb == b"w"):
            super()._execute(verb, sequence, number, now_s)

    def send(self, packet: bytes) -> None:
        """Sends what is left of an answer."""
        fields = list(_ANSWER.unpack(packet[: _ANSWER.size]))
        fields[_ENCODER] -= self._zero
        packet = sealed(fields)

        def with_field(value: Callable[[int], int]) -> Callable[[int], list[bytes]]:
            def message(number: int) -> list[bytes]:
                changed = list(fields)
                place = (_GAUGE, _ENCODER, _TIME, _STATUS, _ACCEPTED)[number % 5]
                changed[place] = value(place)
                return [sealed(changed)]

            return message

        unsigned = {_TIME: 2**32 - 1, _STATUS: 255, _ACCEPTED: 2**16 - 1}
        overloaded = sealed([*fields[:_STATUS], fields[_STATUS] | 2, *fields[_SEQUENCE:]])
        other = sealed([*fields[:_SEQUENCE], fields[_SEQUENCE] ^ 0x100, *fields[_ACCEPTED:]])
        for part in self.line.spoiled(
            0,
            packet,
            {
                "not a number": lambda _: [overloaded],
                "largest value": with_field(lambda place: unsigned.get(place, 2**31 - 1)),
                "smallest value": with_field(lambda place: 0 if place in unsigned else -(2**31)),
                "short message": lambda _: [packet[:11]],
                "long message": lambda _: [packet + b"\x5a\x00\x5a"],
                "wrong checksum": lambda _: [packet[:9] + bytes([packet[9] ^ 4]) + packet[10:]],
                "wrong identifier": lambda _: [other],
                "flood": lambda _: [b"\x5a" * 20, packet] + [other, b"\x5a" * 20] * _FLOOD,
                "noise": lambda _: [b"\x5a\x01garbage", packet],
            },
        ):
            super().send(part)


_TURNS, _BEAT = struct.Struct("<ff"), struct.Struct("<IBBBB")
_OTHER_NODE = (NODE + 5) << 5


class FaultyCan(CanDevices):
    """The ODrive and the gauge on a bus with faults.

    Attributes:
        line: The bus.
        faults: Faults that they can have.
    """

    faults = (*FAULTS, "deaf", "power lost", "no heartbeats")

    def __init__(self, board: EmulatedBoard, address: str) -> None:
        super().__init__(board, address)
        self.line: Line[tuple[int, bytes]] = Line()
        self._zero = 0.0

    @property
    def readable(self) -> list[int]:
        """The listener and every port, while the adapter is plugged in."""
        return super().readable if self.line.fault != "unplugged" else []

    def begin(self, fault: str, messages: int = 0) -> None:
        """Begins a fault."""
        now_s = time.monotonic()
        if fault == "power lost":
            self._estop(b"", now_s)
        elif fault == "reset":
            self._board.power(now_s, on=False)
            self._state, self._errors = 1, 0
            self._zero = self._board.read(now_s)[1] / self.counts_per_turn
            self.line.silent_until_s = now_s + RESTART_s
        elif fault == "unplugged":
            for port in (*self._ports.values(), self._listener):
                port.close()
            self._ports.clear()
            Path(self.address).unlink()
        self.line.begin(fault, messages)

    def end(self) -> None:
        """Ends the fault."""
        if self.line.fault == "unplugged":
            self._listen()
        self.line.end()

    def _torque(self, data: bytes, now_s: float) -> None:
        if self.line.fault != "deaf":
            super()._torque(data, now_s)

    def _send(self, identifier: int, data: bytes) -> None:
        if self.line.fault == "unplugged":
            return
        is_beat = identifier & 0x1F == 0x01 and identifier != GAUGE
        if is_beat and self.line.fault == "no heartbeats":
            return
        if identifier == (NODE << 5) | 0x09:
            data = _TURNS.pack(_TURNS.unpack(data)[0] - self._zero, 0.0)

        if self.line.fault == "flood":
            for number in range(_FLOOD):
                super()._send((NODE << 5 if number % 2 else _OTHER_NODE) | 0x14, b"\xff" * 8)
        for part in self.line.spoiled(identifier, (identifier, data), _forms(identifier, data)):
            super()._send(*part)


def _forms(identifier: int, data: bytes) -> "Forms[tuple[int, bytes]]":
    """What faults make of a frame."""
    is_gauge = identifier == GAUGE
    is_turns = not is_gauge and identifier & 0x1F == 0x09

    def values(gauge: int | None, *turns: float) -> Callable[[int], list[tuple[int, bytes]]]:
        def message(number: int) -> list[tuple[int, bytes]]:
            if is_turns:
                return [(identifier, _TURNS.pack(turns[number % len(turns)], turns[0]))]
            if gauge is None:
                return [(identifier, data)]
            if is_gauge:
                return [(identifier, struct.pack("<i", gauge))]
            return [(identifier, _BEAT.pack(2**32 - 1, 255, 255, 255, 255))]

        return message

    def renamed(*identifiers: int) -> Callable[[int], list[tuple[int, bytes]]]:
        return lambda number: [(identifiers[number % len(identifiers)], data)]

    infinity, largest = float("inf"), 3.4028234e38
    return {
        "not a number": values(None, float("nan")),
        "infinity": values(None, infinity, -infinity),
        "largest value": values(2**31 - 1, largest),
        "smallest value": values(-(2**31), -largest, 1e-45),
        "short message": lambda _: [(identifier, data[: len(data) // 2])],
        "long message": lambda _: [(identifier, data + b"\xff" * (8 - len(data)))],
        "wrong checksum": renamed(identifier | 0x20000000),  # an error frame of the adapter
        "wrong identifier": renamed(_OTHER_NODE | identifier & 0x1F, identifier | 0x80000000),
    }


FAULTY: dict[str, type[FaultySerial] | type[FaultyCan]] = {
    "serial": FaultySerial,
    "can": FaultyCan,
}
"""Devices with faults, by the names of `plants.emulator.devices.DEVICES`."""
