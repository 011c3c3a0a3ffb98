"""Memory shared by a rig and its real-time loop.

One block without a name, which vanishes with the last of the two processes: counters and flags,
the latest readings, two histograms of times, the reason of a stop, the last samples for the black
box, and the columns of one trial.
Each number has one writer. The loop reads the flags at every sample, so that an emergency stop
waits for no message; whatever needs an answer goes through the pipe beside it.
"""

import mmap
import os
import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.errors import RigError
from estune.recordings.black_box_file import ROW
from estune.trial.records import COLUMNS, COMPENSATION_COLUMNS

BIN_s = 2e-6
BINS = 50_000
"""Bins of a histogram, 0 to 100 ms; the last one holds all longer times."""

BOX_ROWS = 8192
"""Samples for the black box: 13 s at 632 Hz; its keeper takes them twice a second."""

_BOX_ROW = struct.Struct("<Q5dBB")  # `black_box_file.ROW`
REASON_BYTES = 512
_COLUMNS = 6 + len(COMPENSATION_COLUMNS)
_BYTES_PER_SAMPLE = 8 * _COLUMNS + 1


class MotionPhase(IntEnum):
    """Mode of the loop."""

    OFF = 0
    TAKE_UP = 1
    HOLD = 2
    TRIAL = 3
    RAMP = 4
    STOPPED = 5


class Word(IntEnum):
    """Integers, and who writes them."""

    BEAT = 0  # rig: counts up as long as the rig lives
    ESTOP = 1  # rig: one while the emergency stop is latched
    ABORT = 2  # rig: number of the trial that is to be stopped
    PHASE = 3  # loop: a `MotionPhase`
    LATCHED = 4  # loop: one while the rig takes no trial until it is cleared
    SAMPLES = 5  # loop: samples run
    LATE = 6  # loop: late ones of them
    MISSED = 7  # loop: sampling instants skipped altogether
    REASON = 8  # loop: bytes of the reason
    ORDER = 9  # rig: bytes of the reason for the emergency stop
    PROGRESS = 10  # loop: samples measured of the trial under way
    IN_POSITION = 12  # loop: one while position control is selected
    SETPOINTS = 11  # rig: setpoints from above so far; the last is in `Memory.target_N`
    BAD = 13  # loop: bad readings so far
    FAULT = 14  # loop: bytes of the fault of the last one
    BUSY = 15  # loop: one while a driver is opened or power switched, which may take its time


_TEXTS = Word.REASON, Word.ORDER, Word.FAULT


class SensorLevels(IntEnum):
    """Latest readings, written by the loop."""

    TIME_s = 0
    SETPOINT_N = 1
    TENSION_N = 2
    CURRENT_A = 3
    ANGLE_rad = 4
    LENGTH_m = 5  # operating point of scheduled live gains; NaN where they are fixed
    SCHEDULED_N = 6  # tension of that operating point


class Timing(NamedTuple):
    """Timing of the loop since it started.

    Attributes:
        missed: Sampling instants skipped altogether.
        lateness: Histogram of the time from the instant to the beginning of the sample.
        turnaround: Histogram of the time from the instant to the current command.
    """

    samples: int
    late: int
    missed: int
    bad: int
    lateness: NDArray[np.int64]
    turnaround: NDArray[np.int64]

    def since(self, earlier: "Timing") -> "Timing":
        """Timing from an earlier one on."""
        pairs: Iterable[tuple[Any, Any]] = zip(self, earlier, strict=True)
        return Timing(*(now - then for now, then in pairs))


def quantile_s(histogram: NDArray[np.int64], share: float) -> float:
    """Quantile of a histogram of `Timing`, to its bin's upper edge, s; at most 100 ms."""
    index = np.searchsorted(np.cumsum(histogram), share * histogram.sum())
    return BIN_s * float(index + 1)


class SharedText:
    """A text in the block, cut to `REASON_BYTES`; its length is a word."""

    def __init__(self, length: Word) -> None:
        self._length = length

    def __get__(self, memory: "Memory", _: type["Memory"] | None = None) -> str:
        data = memory.texts[self._length]
        return bytes(data[: memory.words[self._length]]).decode(errors="replace")

    def __set__(self, memory: "Memory", text: str) -> None:
        data = text.encode()[:REASON_BYTES]
        memory.texts[self._length][: len(data)] = data
        # After the bytes: who reads meanwhile must not see the length of a text not yet there.
        memory.words[self._length] = len(data)


class Memory:
    """The shared block, seen from either process.

    Attributes:
        reason: Why the rig last stopped; written by the loop.
        estop_reason: Reason of the emergency stop; written by the rig.
        fault: Fault of the last bad reading; written by the loop.
        setpoint_N: Setpoint of the trial; written by the rig before it.
        weights: Weight of the squared error in the running cost; written by the rig.
        target_N: Setpoint from above, a single number; written by the rig.
        target_rad: Angle for position control from above, a single number; NaN for tension.
        far_end_m_s: Velocity of the far end from above, a single number; written by the rig.
        time_s: Further columns of the trial, as in a record; written by the loop. Those of
            compensations that are off stay zero.
    """

    reason = SharedText(Word.REASON)
    estop_reason = SharedText(Word.ORDER)
    fault = SharedText(Word.FAULT)

    def __init__(self, file: int, capacity: int) -> None:
        """Maps the block."""
        self._map = mmap.mmap(file, _size(capacity))
        # Views of plain memory: a number is read or written in 40 ns, and nothing is allocated.
        self._next_byte = 0
        self.words = self._take("q", len(Word))
        self.levels = self._take("d", len(SensorLevels))
        self.target_N, self.target_rad = self._take("d", 1), self._take("d", 1)
        self.far_end_m_s = self._take("d", 1)
        self.lateness, self.turnaround = self._take("q", BINS), self._take("q", BINS)
        self.texts = {word: self._take("B", REASON_BYTES) for word in _TEXTS}
        columns = [self._take("d", capacity) for _ in range(_COLUMNS)]
        self.time_s, self.setpoint_N, self.tension_N = columns[:3]
        self.current_A, self.angle_rad, self.weights = columns[3:6]
        for name, column in zip(COMPENSATION_COLUMNS, columns[6:], strict=True):
            setattr(self, name, column)
        self.flags = self._take("B", capacity)
        self._box_at = self._next_byte

    def publish(
        self,
        phase: MotionPhase,
        levels: Sequence[float],
        *,
        latched: bool,
        in_position: bool,
        flags: int = 0,
    ) -> None:
        """Writes the status of the reel; levels in the order of `SensorLevels`."""
        for index, level in enumerate(levels):
            self.levels[index] = level
        words = self.words
        words[Word.IN_POSITION], words[Word.LATCHED] = in_position, latched
        words[Word.PHASE] = phase
        sample = words[Word.SAMPLES] + 1
        place = self._box_at + sample % BOX_ROWS * _BOX_ROW.size
        _BOX_ROW.pack_into(self._map, place, sample, *levels[:5], phase, flags)
        words[Word.SAMPLES] = sample

    def motion_since(self, sample: int) -> NDArray[np.void]:
        """Rows of `black_box_file.ROW` after a sample, oldest first, if they are still there."""
        last = self.words[Word.SAMPLES]
        first = max(sample, last - BOX_ROWS + BOX_ROWS // 8)  # not those being overwritten
        data = self._map[self._box_at : self._box_at + BOX_ROWS * _BOX_ROW.size]
        rows: NDArray[np.void] = np.frombuffer(data, ROW)[
            np.arange(first + 1, last + 1) % BOX_ROWS
        ]
        later: NDArray[np.void] = rows[rows["sample"] > sample]
        return later

    def record(self, index: int, **values: float) -> None:
        """Writes a sample of the trial into the columns of these names."""
        for name, value in values.items():
            getattr(self, name)[index] = value
        self.words[Word.PROGRESS] = index + 1

    def columns(self, count: int, optional: tuple[str, ...] = ()) -> dict[str, Any]:
        """The first samples of the trial as columns of a record; copied, and read-only."""
        names = (*COLUMNS, *optional)
        made: dict[str, Any] = {n: np.array(getattr(self, n)[:count], np.float64) for n in names}
        made["flags"] = np.array(self.flags[:count], np.uint8)
        for array in made.values():
            array.flags.writeable = False
        return made

    def timing(self) -> Timing:
        """Timing of the loop."""
        words = self.words
        counts = words[Word.SAMPLES], words[Word.LATE], words[Word.MISSED], words[Word.BAD]
        return Timing(*counts, np.array(self.lateness), np.array(self.turnaround))

    def _take(self, kind: str, count: int) -> Any:
        """The next numbers of the block."""
        start, size = self._next_byte, count * (8 if kind in "qd" else 1)
        self._next_byte += size
        return memoryview(self._map)[start : start + size].cast(kind)  # type: ignore[call-overload]


def _size(capacity: int) -> int:
    head = 8 * (len(Word) + len(SensorLevels) + 3 + 2 * BINS) + len(_TEXTS) * REASON_BYTES
    return head + _BYTES_PER_SAMPLE * capacity + BOX_ROWS * _BOX_ROW.size


def make_file(capacity: int) -> int:
    """Descriptor of a new block, all zero, for trials of so many samples.

    Raises:
        RigError: this system has none.
    """
    if not hasattr(os, "memfd_create"):
        raise RigError(
            "the real-time loop runs on Linux only; serve the rig there, or let a board close the "
            "loop, and tune it from here by its endpoint"
        )
    file = os.memfd_create("estune-rig")
    os.ftruncate(file, _size(capacity))
    return file
