"""Exchanges with a trial board: a packet out, the answer of the same sequence number back."""

import struct
import threading
import time
from enum import IntEnum
from typing import NamedTuple

from estune.errors import RigError
from estune.hardware.drivers.serial_port import CHECKSUM, SerialPort, sealed

HEAD = struct.Struct("<BcHH")
"""Begin, kind, sequence number, length of what follows; the body; then a CRC-16."""
BEGINS = 0xC3

_STATUS = struct.Struct("<BBBBBII")


class BoardState(IntEnum):
    """Mode of the board."""

    OFF = 0
    TAKE_UP = 1
    MOVE = 2
    HOLD = 3
    TRIAL = 4
    RAMP = 5


class BoardStatus(NamedTuple):
    """State of the board.

    Attributes:
        latched: 1 if it takes no trial until it is cleared.
        pending: 1 from the acceptance of a trial to its end.
        outcome: Of the last trial: none, done, guard, cancelled, interrupted.
        reason: Why it ended; see `REASONS`.
        done: Samples recorded of it.
    """

    state: BoardState
    latched: int
    pending: int
    outcome: int
    reason: int
    trial: int
    done: int


REASONS = (
    "",
    "the tension crossed the board's limit",
    "the drum turned further than the board allows",
    "the board heard nothing from the computer",
    "stopped",
    "emergency stop",
    "the cable did not become taut",
    "the tension did not settle at the preload",
    "tension or angle could not be measured: a fault of the board's sensors",
)
"""Why a trial or motion ended, by number."""


class BoardLink:
    """The line to a board; any thread may use it.

    Args:
        port: The device, such as /dev/ttyACM0.
        baud: Rate of the line.
        answer_within_s: Time after which a request is repeated; every request may be.
        attempts: Requests before the board is given up.

    Raises:
        RigError: there is no port.
    """

    def __init__(self, port: str, baud: int, answer_within_s: float, attempts: int) -> None:
        self._port = SerialPort(port, baud)
        self._name, self._within_s, self._attempts = port, answer_within_s, attempts
        self._lock = threading.Lock()
        self._sequence = 0
        self._bytes = b""

    def status(self, kind: bytes, body: bytes = b"") -> BoardStatus:
        """Sends a request that is answered by the board's status.

        Raises:
            RigError: the board does not answer, or not by a status.
        """
        answer = self.exchange(kind, body)
        try:
            numbers = _STATUS.unpack(answer)
            return BoardStatus(BoardState(numbers[0]), *numbers[1:])
        except (struct.error, ValueError) as error:
            raise RigError(
                f"the board at {self._name} answers {kind!r} by {answer.hex()}, no status "
                f"({error}); flash the program that this version exports"
            ) from error

    def exchange(self, kind: bytes, body: bytes) -> bytes:
        """The body of the answer to a request.

        Raises:
            RigError: the board does not answer.
        """
        with self._lock:
            self._sequence = (self._sequence + 1) & 0xFFFF
            packet = HEAD.pack(BEGINS, kind, self._sequence, len(body)) + body
            for _ in range(self._attempts):
                self._port.write(sealed(packet))
                deadline_s = time.monotonic() + self._within_s
                while data := self._port.read(deadline_s):
                    answer = self._taken(data, kind)
                    if answer is not None:
                        return answer
        lost = self._port.fault and f" ({self._port.fault})"
        raise RigError(
            f"the board at {self._name} has not answered {self._attempts} requests{lost}; it "
            "stops by itself: check its supply and the cable"
        )

    def close(self) -> None:
        """Closes the port. May be called again."""
        with self._lock:
            self._port.close()

    def _taken(self, data: bytes, kind: bytes) -> bytes | None:
        """The body of the answer to the last request, once it is complete."""
        self._bytes += data
        while len(self._bytes) >= HEAD.size + CHECKSUM.size:
            begins, own, sequence, length = HEAD.unpack_from(self._bytes)
            end = HEAD.size + length
            packet = self._bytes[:end]
            if begins == BEGINS and length <= 240 and len(self._bytes) < end + CHECKSUM.size:
                return None
            whole = end + CHECKSUM.size
            if begins != BEGINS or sealed(packet) != self._bytes[:whole]:
                self._bytes = self._bytes[1:]
                continue
            self._bytes = self._bytes[whole:]
            if (own, sequence) == (kind, self._sequence):
                return packet[HEAD.size :]
        return None
