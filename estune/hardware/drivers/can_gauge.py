"""A strain gauge's converter on a CAN bus."""

import math
import struct
import time

from estune.core.quantities import check_positive
from estune.errors import InvalidInput
from estune.hardware.driver import GaugeReading, MessageCount
from estune.hardware.drivers.can_bus import CanSocket, Frame, frame_bits

ATTEMPTS = 3
"""Requests for a reading within `answer_within_s`."""


class CanGauge:
    """A gauge for `estune.hardware.drivers.paired`; implements `estune.hardware.Gauge`.

    Args:
        interface: The CAN interface, such as can0.
        identifier: Identifier of the frame with the counts.
        layout: Its data in the notation of Python's `struct`, the counts first.
        requested: Whether the gauge answers remote requests; else it sends by itself.
        answer_within_s: Time within which a requested frame must have come, which is asked for
            three times; of a gauge that sends by itself, the greatest age of its last frame.
        overload: Counts that stand for an overload, or None.
        rate_Hz: Rate to which a gauge that sends by itself was set; `estune doctor` compares it.
        bits_per_s: Rate of the bus, from which `estune doctor` computes the time on the wire.

    Raises:
        RigError: there is no such interface.
        InvalidInput: a value is out of its range, or the layout does not begin with a number.
    """

    def __init__(
        self,
        interface: str,
        identifier: int,
        *,
        layout: str = "<i",
        requested: bool = True,
        answer_within_s: float = 0.003,
        overload: int | None = None,
        rate_Hz: float = math.nan,
        bits_per_s: int = 1_000_000,
    ) -> None:
        try:
            self._layout = struct.Struct(layout)
        except struct.error as error:
            raise InvalidInput(f"layout {layout!r}: {error}; write it as for struct") from error
        numbers = self._layout.unpack(bytes(self._layout.size))
        if not (numbers and isinstance(numbers[0], int | float)):
            raise InvalidInput(f"layout {layout!r} does not begin with a number, the counts")
        if not 0 <= identifier <= 0x7FF:
            raise InvalidInput(f"identifier is {identifier:#x}; it must be from 0 to 0x7ff")
        self._identifier, self._requested = identifier, requested
        self._within_s, self._overload = answer_within_s, overload
        check_positive("answer_within_s", answer_within_s, "s")  # after NaN no wait would end
        check_positive("bits_per_s", bits_per_s, "bit/s")
        self._rate_Hz, self._bits_per_s = rate_Hz, bits_per_s
        self._last: GaugeReading | None = None
        self._refused = ""  # what came in place of a reading
        self._asked = self._seen = 0
        self._bus = CanSocket(interface, identifier, identifier)
        self._opened_s = time.monotonic()

    @property
    def waited_s(self) -> float:
        """Time spent waiting for frames, s."""
        return self._bus.waited_s

    def messages(self) -> tuple[MessageCount, ...]:
        """Readings that came, and that were asked for or are due by the gauge's own rate."""
        due = self._rate_Hz * (time.monotonic() - self._opened_s)
        bits = frame_bits(self._layout.size) + (frame_bits(0) if self._requested else 0)
        expected = self._asked if self._requested else due
        return (MessageCount("gauge", expected, self._seen, bits / self._bits_per_s),)

    def request(self) -> None:
        """Asks for a reading, where the gauge has to be asked."""
        self._refused = self._bus.fault = ""
        if self._requested:
            self._take(self._bus.waiting())
            self._last = None
            self._bus.send(Frame(self._identifier, remote=True))
            self._asked += 1

    def read(self) -> GaugeReading:
        """The newest reading, stamped at its arrival; a request is repeated."""
        self._take(self._bus.waiting())
        attempts = ATTEMPTS if self._requested else 1
        for attempt in range(attempts):
            if attempt:
                self.request()
            deadline_s = time.monotonic() + self._within_s / attempts
            while not self._is_fresh and (frames := self._bus.until(deadline_s)):
                self._take(frames)
                if time.monotonic() > deadline_s:
                    break  # a bus that is flooded always has frames
            if self._last is not None and self._is_fresh:
                return self._last
        asked = f" after {attempts} requests" if self._requested else ""
        missing = f"no frame of the gauge within {self._within_s:g} s{asked}"
        fault = self._bus.fault or missing + (self._refused and f": it sent {self._refused}")
        return GaugeReading(time.monotonic(), math.nan, fault)

    @property
    def _is_fresh(self) -> bool:
        last = self._last
        return last is not None and last.time_s >= time.monotonic() - self._within_s

    def close(self) -> None:
        """Closes the interface. May be called again."""
        self._bus.close()

    def _take(self, frames: list[Frame]) -> None:
        for frame in frames:
            if len(frame.data) < self._layout.size:
                self._refused = f"{len(frame.data)} bytes in place of {self._layout.size}"
                continue
            counts = self._layout.unpack_from(frame.data)[0]
            if counts == self._overload:
                counts = math.nan
            elif not math.isfinite(counts):
                self._refused = f"{counts} counts"
                continue
            self._seen += 1
            self._last = GaugeReading(time.monotonic(), float(counts))
