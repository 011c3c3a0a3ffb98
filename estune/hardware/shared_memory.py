"""The memory that a rig and its real-time loop share.

One block without a name, which vanishes with the last of the two processes: counters and flags,
the latest readings, two histograms of times, the reason of a stop, and the columns of one trial.
Each number has one writer. Flags are looked at every sample, so that an emergency stop waits for
no message; whatever needs an answer goes through the pipe beside it.
"""

import mmap
import os
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray

BIN_s = 2e-6
BINS = 50_000
"""Times from 0 to 100 ms; the last bin holds what is longer."""

REASON_BYTES = 512
_COLUMNS = 6
_BYTES_PER_SAMPLE = 8 * _COLUMNS + 1


class Word(IntEnum):
    """Whole numbers, and who writes them."""

    BEAT = 0  # rig: goes on as long as the rig lives
    ESTOP = 1  # rig: one while the emergency stop is latched
    ABORT = 2  # rig: number of the trial that is to be stopped
    PHASE = 3  # loop: see `estune.hardware.reel_state_machine.MotionPhase`
    LATCHED = 4  # loop: one while the rig takes no trial until it is cleared
    SAMPLES = 5  # loop: how many it has run
    LATE = 6  # loop: how many of them were late
    MISSED = 7  # loop: sampling instants it has passed over altogether
    REASON = 8  # loop: bytes of the reason
    ORDER = 9  # rig: bytes of the reason for the emergency stop
    PROGRESS = 10  # loop: samples measured of the trial under way


class SensorLevels(IntEnum):
    """The latest readings, written by the loop."""

    TIME_s = 0
    SETPOINT_N = 1
    TENSION_N = 2
    CURRENT_A = 3
    ANGLE_rad = 4
    LENGTH_m = 5  # that the live gains are for; not a number where they are fixed
    SCHEDULED_N = 6  # tension that they are for; the same


class Memory:
    """The shared block, seen from either process.

    Attributes:
        words: See `Word`.
        levels: See `SensorLevels`.
        lateness: How long after its instant a sample began, histogram.
        turnaround: How long after its instant the current was commanded, histogram.
        time_s: Columns of the trial under way: when each sample was read.
        setpoint_N: What is to be followed; written by the rig before the trial.
        tension_N: As in a record.
        current_A: As in a record.
        angle_rad: As in a record.
        weights: Weight of the squared error in the running cost; written by the rig.
        flags: As in a record.
    """

    def __init__(self, file: int, capacity: int) -> None:
        """Maps the block.

        Args:
            file: Descriptor of a file of `size(capacity)` bytes.
            capacity: Samples of the longest trial.
        """
        self._map = mmap.mmap(file, size(capacity))
        # Views of plain memory: a number is read or written in 40 ns, and nothing is allocated.
        self._views: list[memoryview] = []
        self.words = self._next("q", len(Word))
        self.levels = self._next("d", len(SensorLevels))
        self.lateness, self.turnaround = self._next("q", BINS), self._next("q", BINS)
        self._reason, self._order = self._next("B", REASON_BYTES), self._next("B", REASON_BYTES)
        columns = [self._next("d", capacity) for _ in range(_COLUMNS)]
        self.time_s, self.setpoint_N, self.tension_N = columns[:3]
        self.current_A, self.angle_rad, self.weights = columns[3:]
        self.flags = self._next("B", capacity)

    @property
    def reason(self) -> str:
        """Why the rig last stopped; written by the loop."""
        return bytes(self._reason[: self.words[Word.REASON]]).decode(errors="replace")

    @reason.setter
    def reason(self, text: str) -> None:
        self._write(self._reason, Word.REASON, text)

    @property
    def order(self) -> str:
        """Why the emergency stop was called; written by the rig."""
        return bytes(self._order[: self.words[Word.ORDER]]).decode(errors="replace")

    @order.setter
    def order(self, text: str) -> None:
        self._write(self._order, Word.ORDER, text)

    def _write(self, room: memoryview, length: Word, text: str) -> None:
        data = text.encode()[:REASON_BYTES]
        room[: len(data)] = data
        self.words[length] = len(data)

    def close(self) -> None:
        """Unmaps the block."""
        for view in reversed(self._views):
            view.release()
        self._map.close()

    def _next(self, kind: str, count: int) -> Any:
        """The next numbers of the block."""
        item = 8 if kind in "qd" else 1
        start = sum(view.nbytes for view in self._views[::3])
        whole = memoryview(self._map)
        part = whole[start : start + item * count]
        view = part.cast(kind)  # type: ignore[call-overload]
        self._views += [view, part, whole]
        return view


def size(capacity: int) -> int:
    """Bytes of a block for trials of so many samples."""
    head = 8 * (len(Word) + len(SensorLevels) + 2 * BINS) + 2 * REASON_BYTES
    return head + _BYTES_PER_SAMPLE * capacity


def make_file(capacity: int) -> int:
    """The descriptor of a new block, all zero."""
    file = os.memfd_create("estune-rig")
    os.ftruncate(file, size(capacity))
    return file


def column(view: memoryview, count: int) -> FloatArray:
    """The first numbers of a column, copied."""
    return np.array(view[:count], np.float64)


def flag_column(view: memoryview, count: int) -> NDArray[np.uint8]:
    """The first flags, copied."""
    return np.array(view[:count], np.uint8)
