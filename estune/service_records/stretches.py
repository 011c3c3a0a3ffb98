"""Stretches of a log without a gap, and those in which the controller's equation holds.

The first show the plant, the second the gains.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import BoolArray, FloatArray
from estune.recordings.loop_log import LoopLog
from estune.recordings.timing import Columns

STANDS_STILL = 3
"""Equal efforts in a row, at least, that show a limit or another mode. Two occur by chance where
the effort is logged in coarse steps."""

SHORTEST = 32
"""Samples of the shortest stretch. Start states and offset of a fit of six poles are eight
numbers, four samples for each."""

TOO_SHORT = f"shorter than {SHORTEST} samples"


class Stretch(NamedTuple):
    """Successive samples of a log, shape (samples,) each, in the units of the log.

    Attributes:
        setpoint: Setpoint before its filter.
        effort: Effort as logged, or None.
        limits: Limits at which the effort was held, in its unit.
    """

    log: str
    start_s: float
    setpoint: FloatArray
    measurement: FloatArray
    effort: FloatArray | None
    limits: tuple[float, float] = (-math.inf, math.inf)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.measurement.size

    def part(self, rows: slice, sampling_Hz: float = math.inf) -> "Stretch":
        """Some of its samples; without the sampling rate with the time of its first."""
        return self._replace(
            start_s=self.start_s + rows.start / sampling_Hz,
            setpoint=self.setpoint[rows],
            measurement=self.measurement[rows],
            effort=None if self.effort is None else self.effort[rows],
        )


def moving_part(stretch: Stretch, samples: int) -> Stretch:
    """The part of at most so many samples in which the setpoint moves most, in quarters of it."""
    if stretch.samples <= samples:
        return stretch
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(stretch.setpoint)))])
    begins = np.arange(0, stretch.samples - samples + 1, samples // 4)
    first = int(begins[np.argmax(way[begins + samples - 1] - way[begins])])
    return stretch.part(slice(first, first + samples))


class LeftOut(NamedTuple):
    """Part of a log that is not used."""

    log: str
    start_s: float
    stop_s: float
    reason: str


def whole_stretches(log: LoopLog) -> tuple[list[Stretch], list[LeftOut]]:
    """The stretches of a log without a gap, and what lies between or is too short.

    The logged effort drives the plant at a limit or by hand as well: a warm-up at the limit shows
    more of it than anything else.
    """
    stretches, left_out = [], _gaps(log)
    for part in log.parts:
        rows = slice(0, part["time"].size)
        if rows.stop < SHORTEST:
            left_out.append(_too_short(log, part, rows))
        else:
            limits = _limits(part, _stands_still(part, _proportional(log)))
            stretches.append(_stretch(log.name, part, rows)._replace(limits=limits))
    return stretches, left_out


def find_stretches(
    log: LoopLog, P: float | None, shortest: int = SHORTEST
) -> tuple[list[Stretch], list[LeftOut]]:
    """The stretches of a log in which the controller's equation holds, and the rest with reasons.

    Args:
        P: Proportional gain that ran, by which it is known whether the effort should have moved;
            None estimates it from the moves of effort and error.
        shortest: Samples of the shortest stretch.
    """
    P = _proportional(log) if P is None else P
    stretches, left_out = [], _gaps(log)
    for part in log.parts:
        time, held = part["time"], _stands_still(part, P)
        for rows in _runs(held):
            why = _why_still(part, rows)
            left_out.append(LeftOut(log.name, *_ends(time, rows), why))
        for rows in _runs(~held):
            if rows.stop - rows.start < shortest:
                left_out.append(_too_short(log, part, rows))
            else:
                stretches.append(_stretch(log.name, part, rows))
    return stretches, sorted(left_out, key=lambda part: part.start_s)


def _gaps(log: LoopLog) -> list[LeftOut]:
    ends = [
        (float(before["time"][-1]), float(after["time"][0]))
        for before, after in zip(log.parts, log.parts[1:], strict=False)
    ]
    return [LeftOut(log.name, *pair, "samples are missing") for pair in ends]


def _too_short(log: LoopLog, part: Columns, rows: slice) -> LeftOut:
    return LeftOut(log.name, *_ends(part["time"], rows), TOO_SHORT)


def unused(stretch: Stretch, sampling_Hz: float, reason: str = TOO_SHORT) -> LeftOut:
    """A stretch that is left out."""
    stop_s = stretch.start_s + (stretch.samples - 1) / sampling_Hz
    return LeftOut(stretch.log, stretch.start_s, stop_s, reason)


def _limits(part: Columns, held: BoolArray) -> tuple[float, float]:
    """Least and greatest effort where it was held there, else infinite."""
    if not held.any():
        return -math.inf, math.inf
    effort, at = part["effort"], part["effort"][held]
    least, most = float(effort.min()), float(effort.max())
    return (
        least if (at == least).any() else -math.inf,
        most if (at == most).any() else math.inf,
    )


def _proportional(log: LoopLog) -> float:
    """About the proportional gain that ran, by least squares of moves of the effort on errors'."""
    moves = [
        (np.diff(part["effort"]), np.diff(part["setpoint"] - part["measurement"]))
        for part in log.parts
        if "effort" in part
    ]
    power = sum(float(error @ error) for _, error in moves)
    return abs(sum(float(effort @ error) for effort, error in moves)) / max(power, 1e-300)


def _stretch(name: str, part: Columns, rows: slice) -> Stretch:
    effort = part["effort"][rows] if "effort" in part else None
    start_s = float(part["time"][rows.start])
    return Stretch(name, start_s, part["setpoint"][rows], part["measurement"][rows], effort)


def _stands_still(part: Columns, P: float) -> BoolArray:
    """Samples of equal efforts while the error moves by more than a step of the logged effort."""
    still: BoolArray = np.zeros(part["time"].size, np.bool_)
    effort = part.get("effort")
    if effort is None:
        return still
    jumps, error = np.abs(np.diff(effort)), part["setpoint"] - part["measurement"]
    resolution = float(jumps[jumps > 0.0].min(initial=np.inf))
    equal = np.concatenate([[False], jumps == 0.0])
    for rows in _runs(equal):
        run = slice(rows.start - 1, rows.stop)
        moves = P * float(np.ptp(error[run])) > 2.0 * resolution
        if run.stop - run.start >= STANDS_STILL and moves:
            still[run] = True
    for limit in (effort.min(), effort.max()):
        if still[effort == limit].any():  # held there once, it is a limit at every touch
            still |= effort == limit
    return still


def _why_still(part: Columns, rows: slice) -> str:
    effort = part["effort"]
    value = effort[rows.start]
    if value == effort.max():
        return f"the effort is at its upper limit, {value:g}"
    if value == effort.min():
        return f"the effort is at its lower limit, {value:g}"
    return f"the effort is held at {value:g}: another mode than automatic"


def _runs(mask: BoolArray) -> Sequence[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]


def _ends(time: FloatArray, rows: slice) -> tuple[float, float]:
    return float(time[rows.start]), float(time[rows.stop - 1])
