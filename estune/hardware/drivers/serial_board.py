"""A reel, or a gauge alone, behind a microcontroller on a serial port.

The page docs/how-to/hardware.md says what the board has to do.

Every packet ends with a checksum and carries a sequence number, so that a damaged, stale or
doubled answer is never taken for a reading; the board stamps its readings itself.
"""

import math
import struct
import time
from collections import Counter
from typing import NamedTuple, Self

from estune.core.quantities import check_positive
from estune.errors import RigError
from estune.hardware.driver import GaugeReading, MessageCount, Reading, bad_reading
from estune.hardware.drivers.board_clock import BoardClock, unwrapped
from estune.hardware.drivers.serial_port import CHECKSUM, SerialPort, sealed

REQUEST = struct.Struct("<BcHi")
"""Begin, verb, sequence number, current command in counts."""
ANSWER = struct.Struct("<BBHHIii")
"""Begin, status, sequence number of the request, of the last command accepted, time in us, gauge,
encoder."""
REQUEST_BEGINS, ANSWER_BEGINS = 0xA5, 0x5A

READ, WRITE, ENABLE, DISABLE, SAFE = b"r", b"w", b"e", b"d", b"s"

POWERED, OVERLOAD, WATCHDOG = 1, 2, 4
"""Bits of the status: the amplifier has power; the gauge's reading is not valid; the board's
watchdog has cut the current."""

ATTEMPTS = 3
"""Requests of one reading within its time; reading has no effect, so it may be repeated."""
LOST_MAX = 2
"""Commands in a row that may be lost before a reading counts as bad."""
POWERED_WITHIN_s = 1.0


class BoardAnswer(NamedTuple):
    """One answer of the board, without its first byte."""

    status: int
    sequence: int
    accepted: int
    time_us: int
    gauge: int
    encoder: int


class AnswerStream:
    """Answers in a stream of bytes, in which some may be missing, doubled or damaged."""

    def __init__(self) -> None:
        self._bytes = b""

    def feed(self, data: bytes) -> list[BoardAnswer]:
        """The valid answers that these bytes complete."""
        self._bytes += data
        found, size, at = [], ANSWER.size + CHECKSUM.size, 0
        # The bytes are cut once: garbage costs a search, and no copy for each byte of it.
        while 0 <= (at := self._bytes.find(ANSWER_BEGINS, at)) <= len(self._bytes) - size:
            packet = self._bytes[at : at + ANSWER.size]
            if sealed(packet) == self._bytes[at : at + size]:
                found.append(BoardAnswer(*ANSWER.unpack(packet)[1:]))
                at += size
            else:
                at += 1
        self._bytes = self._bytes[at:] if at >= 0 else b""
        return found


class SerialBoard:
    """Drives a reel behind a board; implements `estune.hardware.Driver`.

    Args:
        port: The device, such as /dev/ttyACM0.
        baud: Rate of the line; boards with USB of their own ignore it. A sample takes 400 bits.
        answer_within_s: Time within which a reading must have come, repeated requests included.

    Raises:
        RigError: there is no port, or no board that answers at it.
        InvalidInput: a value is out of its range.
    """

    def __init__(self, port: str, baud: int = 921600, answer_within_s: float = 0.003) -> None:
        check_positive("answer_within_s", answer_within_s, "s")  # after NaN no wait would end
        self._wait_s = answer_within_s / ATTEMPTS
        self._stream = AnswerStream()
        self._clock = BoardClock()
        self._sequence = self._written = self._encoder = self._lost = 0
        self._counts = Counter[str]()
        self._enabled = self._unread = False
        self._last: Reading | None = None
        self._port = SerialPort(port, baud)
        first = self._exchange()
        if first is None:
            self._port.close()
            raise RigError(f"no board answers at {port}; check its program and the rate")
        self._written = first.accepted

    @property
    def waited_s(self) -> float:
        """Time spent waiting for answers, s."""
        return self._port.waited_s

    def messages(self) -> tuple[MessageCount, ...]:
        """Readings asked for and had; commands sent and accepted."""
        n, byte_s = self._counts, self._port.byte_s
        request = REQUEST.size + CHECKSUM.size
        reading_s = byte_s * (request + ANSWER.size + CHECKSUM.size)
        return (
            MessageCount("reading", n["asked"], n["answered"], reading_s),
            MessageCount("command", n["written"], n["accepted"], byte_s * request),
        )

    def enable(self) -> None:
        """Gives the amplifier power, and waits until the board says so; else readings are bad."""
        deadline_s = time.monotonic() + POWERED_WITHIN_s
        self._say(ENABLE)
        self._enabled = True
        while time.monotonic() < deadline_s:
            answer = self._exchange()
            if answer is not None and answer.status & POWERED:
                return

    def read(self) -> Reading:
        """Reads gauge and encoder; a reading is bad, too, where the board does not obey."""
        answer = self._exchange()
        fault = "" if answer is None else self._disobedience(answer)
        return bad_reading(fault, self._last) if fault else self._reading(answer)

    def measure(self) -> Reading:
        """Reads gauge and encoder of a board that is commanded nothing."""
        return self._reading(self._exchange())

    def _reading(self, answer: BoardAnswer | None) -> Reading:
        if answer is None:
            waited = f"has not answered {ATTEMPTS} requests within {ATTEMPTS * self._wait_s:g} s"
            return bad_reading(self._port.fault or f"the board {waited}", self._last)
        counts = math.nan if answer.status & OVERLOAD else float(answer.gauge)
        self._encoder = unwrapped(answer.encoder, self._encoder)
        self._last = Reading(self._clock.time_s, counts, self._encoder)
        return self._last

    def _disobedience(self, answer: BoardAnswer) -> str:
        """Why the board is not under command; empty where it is."""
        if self._enabled and not answer.status & POWERED:
            cause = "watchdog" if answer.status & WATCHDOG else "own protection"
            return f"the board's {cause} has cut the amplifier's power; check the board"
        accepted = answer.accepted == self._written
        self._lost = 0 if accepted else self._lost + 1
        self._counts["accepted"] += accepted and self._unread
        self._unread = False
        if self._lost > LOST_MAX:
            return f"{self._lost} commands in a row did not reach the board; check the line"
        return ""

    def write(self, current_counts: int) -> None:
        """Commands a motor current, which feeds the board's watchdog."""
        self._say(WRITE, current_counts)
        self._written = self._sequence
        self._counts["written"] += 1
        self._unread = True

    def disable(self) -> None:
        """Removes the amplifier's power."""
        self._enabled = False
        self._say(DISABLE)

    def safe_state(self) -> None:
        """Brings the board to its own safe state: no power, and whatever brake it has."""
        self._enabled = False
        self._say(SAFE)

    def close(self) -> None:
        """Closes the port. May be called again."""
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.disable()
        finally:
            self.close()

    def _say(self, verb: bytes, number: int = 0) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._port.write(sealed(REQUEST.pack(REQUEST_BEGINS, verb, self._sequence, number)))

    def _exchange(self) -> BoardAnswer | None:
        """The answer to a request for a reading, if it comes; any other is old, and discarded."""
        for _ in range(ATTEMPTS):
            self._say(READ)
            self._counts["asked"] += 1
            deadline_s = time.monotonic() + self._wait_s
            while data := self._port.read(deadline_s):
                for answer in self._stream.feed(data):
                    if answer.sequence == self._sequence:
                        self._clock = self._clock.stamped(answer.time_us, time.monotonic())
                        self._counts["answered"] += 1
                        return answer
                if time.monotonic() > deadline_s:
                    break  # a line that is flooded always has bytes
        return None


class SerialGauge:
    """The gauge of a board, beside a drive of another kind; implements `estune.hardware.Gauge`."""

    def __init__(self, port: str, baud: int = 921600, answer_within_s: float = 0.003) -> None:
        self._board = SerialBoard(port, baud, answer_within_s)

    @property
    def waited_s(self) -> float:
        """Time spent waiting for answers, s."""
        return self._board.waited_s

    def messages(self) -> tuple[MessageCount, ...]:
        """Readings asked for and had."""
        return self._board.messages()[:1]

    def request(self) -> None:
        """Nothing: the board answers at once."""

    def read(self) -> GaugeReading:
        """Reads the gauge."""
        reading = self._board.measure()
        return GaugeReading(reading.time_s, reading.gauge_counts, reading.fault)

    def close(self) -> None:
        """Closes the port. May be called again."""
        self._board.close()
