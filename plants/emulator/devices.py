"""The emulated reel behind the protocols of real devices: a serial board, an ODrive with a gauge.

They are written from the protocols, on their own: only the layouts of the packets are shared with
the drivers in `estune.hardware.drivers`.
"""

import binascii
import os
import socket
import struct
import tty
from collections.abc import Callable
from typing import Protocol

from plants.emulator.board import EmulatedBoard

_REQUEST, _ANSWER = struct.Struct("<BcHi"), struct.Struct("<BBHHIii")
_CAN = struct.Struct("<IB3x8s")
_REMOTE = 0x40000000
HEARTBEAT_s = 0.1


class Device(Protocol):
    """One kind of device on its bus."""

    address: str

    @property
    def readable(self) -> list[int]:
        """Files whose bytes it takes."""
        ...

    def take(self, file: int, now_s: float) -> None:
        """Executes what has arrived on a file, and answers."""
        ...

    def tick(self, now_s: float) -> None:
        """Sends what the device sends by itself."""
        ...


class SerialDevice:
    """The board of `estune.hardware.drivers.serial_board` on a pseudo-terminal."""

    def __init__(self, board: EmulatedBoard, _address: str) -> None:
        self._board = board
        self._file, self._far = os.openpty()  # the far end stays open between two drivers
        tty.setraw(self._file)
        tty.setraw(self._far)
        self.address = os.ttyname(self._far)
        self._bytes = b""
        self._accepted = 0

    @property
    def readable(self) -> list[int]:
        """The near end."""
        return [self._file]

    def take(self, file: int, now_s: float) -> None:
        """Executes the requests in what has arrived."""
        self._bytes += os.read(file, 4096)
        size = _REQUEST.size + 2
        while len(self._bytes) >= size:
            packet = self._bytes[: size - 2]
            (checksum,) = struct.unpack("<H", self._bytes[size - 2 : size])
            if packet[0] != 0xA5 or binascii.crc_hqx(packet, 0xFFFF) != checksum:
                self._bytes = self._bytes[1:]
                continue
            self._bytes = self._bytes[size:]
            _, verb, sequence, number = _REQUEST.unpack(packet)
            self._execute(verb, sequence, number, now_s)

    def tick(self, now_s: float) -> None:
        """Nothing: the board only answers."""

    def _execute(self, verb: bytes, sequence: int, number: int, now_s: float) -> None:
        if verb == b"w":
            self._board.write(now_s, number)
            self._accepted = sequence
        elif verb in (b"e", b"d", b"s"):
            self._board.power(now_s, on=verb == b"e")
        elif verb == b"r":
            gauge, encoder = self._board.read(now_s)
            truth = self._board.truth(now_s)
            status = (1 if truth.powered else 0) | (
                4 if truth.tripped and not truth.powered else 0
            )
            wrapped = ((encoder + 2**31) % 2**32) - 2**31
            stamp = int(now_s * 1e6) % 2**32
            answer = _ANSWER.pack(*(0x5A, status, sequence, self._accepted, stamp, gauge, wrapped))
            self.send(answer + struct.pack("<H", binascii.crc_hqx(answer, 0xFFFF)))

    def send(self, packet: bytes) -> None:
        """Sends an answer."""
        os.write(self._file, packet)


NODE, GAUGE = 0, 0x321
"""Node id of the emulated ODrive, identifier of the emulated gauge."""


class CanDevices:
    """An ODrive and a gauge on one bus: a local socket that carries the frames of SocketCAN."""

    newton_metres_per_count = 1e-4
    counts_per_turn = 8192

    def __init__(self, board: EmulatedBoard, address: str) -> None:
        self._board = board
        self.address = f"{address}.can"
        self._listen()
        self._ports: dict[int, socket.socket] = {}
        self._state, self._errors, self._beat_s = 1, 0, 0.0
        node = NODE << 5
        self._verbs: dict[int, Callable[[bytes, float], None]] = {
            node | 0x02: self._estop,
            node | 0x07: self._set_state,
            node | 0x0E: self._torque,
            node | 0x18: self._clear_errors,
        }

    def _listen(self) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(self.address)
        self._listener.listen()

    @property
    def readable(self) -> list[int]:
        """The listener and every port of the bus."""
        return [self._listener.fileno(), *self._ports]

    def take(self, file: int, now_s: float) -> None:
        """Takes a new port, or a frame of one."""
        if file == self._listener.fileno():
            port, _ = self._listener.accept()
            self._ports[port.fileno()] = port
            return
        try:
            packet = self._ports[file].recv(_CAN.size)
        except OSError:
            packet = b""
        if not packet:
            self._ports.pop(file).close()
            return
        identifier, length, data = _CAN.unpack(packet)
        if identifier & _REMOTE:
            self._answer(identifier & 0x7FF, now_s)
        elif identifier in self._verbs:
            self._verbs[identifier](data[:length], now_s)

    def tick(self, now_s: float) -> None:
        """Sends the heartbeat; the axis leaves closed loop where the watchdog has tripped."""
        if self._state == 8 and not self._board.truth(now_s).powered:
            self._state, self._errors = 1, 0x800
        if now_s - self._beat_s > HEARTBEAT_s:
            self._beat(now_s)

    def _answer(self, identifier: int, now_s: float) -> None:
        gauge, encoder = self._board.read(now_s)
        if identifier == (NODE << 5) | 0x09:
            self._send(identifier, struct.pack("<ff", encoder / self.counts_per_turn, 0.0))
        elif identifier == GAUGE:
            self._send(identifier, struct.pack("<i", gauge))

    def _estop(self, _data: bytes, now_s: float) -> None:
        self._board.power(now_s, on=False)
        self._state, self._errors = 1, 0x1000
        self._beat(now_s)

    def _set_state(self, data: bytes, now_s: float) -> None:
        (wanted,) = struct.unpack("<I", data)
        self._state = wanted if not self._errors else 1
        self._board.power(now_s, on=self._state == 8)
        self._beat(now_s)

    def _torque(self, data: bytes, now_s: float) -> None:
        (torque_Nm,) = struct.unpack("<f", data)
        self._board.write(now_s, round(torque_Nm / self.newton_metres_per_count))

    def _clear_errors(self, _data: bytes, _now_s: float) -> None:
        self._errors = 0

    def _beat(self, now_s: float) -> None:
        self._beat_s = now_s
        self._send((NODE << 5) | 0x01, struct.pack("<IBBBB", self._errors, self._state, 0, 0, 0))

    def _send(self, identifier: int, data: bytes) -> None:
        for port in self._ports.values():
            try:
                port.send(_CAN.pack(identifier, len(data), data), socket.MSG_DONTWAIT)
            except OSError:
                continue  # its reader has gone, or is behind: frames are lost, as on a bus


DEVICES: dict[str, Callable[[EmulatedBoard, str], Device]] = {
    "serial": SerialDevice,
    "can": CanDevices,
}
"""Devices by the setting `device` of `python -m plants.emulator`."""
