"""Faults that a sensor's column shows by itself: a rail, a frozen reading, a dropout, a shift."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.noise import step_of, upper_rms

FROZEN = 20
"""Equal readings in a row from which a noisy sensor is frozen."""
HELD = 12.0
"""Range of the tension, in its noise and what a step of the encoder stands for, in which the angle
cannot stand still."""
JUMP = 8.0
"""A jump so many times as large as the largest of the usual ones, there and back, is a dropout."""
USUAL = 0.99
BACK = 5
"""Samples within which a dropout is over."""
MOST = 0.3
"""Share of a record that may be lost before it is refused."""
RAIL = 0.005
"""Share of samples at the extreme from which a rail is told of."""
SHIFTS = 20
"""Samples by which two channels are tried against each other."""
LEAST_SHIFT = 2
BETTER = 0.3
"""What a shift must leave of the residual to be believed."""


class Fault(NamedTuple):
    """What is wrong with a column.

    Attributes:
        refused: Whether the record cannot be used.
        row: First data row it is about, from 1, or None.
        sentence: What is wrong and what to do.
    """

    refused: bool
    row: int | None
    sentence: str


def faults(column: FloatArray) -> Iterator[Fault]:
    """The faults of a sensor's readings, shape (samples,)."""
    if upper_rms(column) > step_of(column):  # else readings rest on a step of the converter
        yield from _at_rail(column)
        yield from _frozen(column)
    yield from _dropouts(column)


def _at_rail(column: FloatArray) -> Iterator[Fault]:
    """The greatest or the least reading comes again and again, in spite of the noise."""
    for end in (column.min(), column.max()):
        at = column == end
        share = float(at.mean())
        if share >= RAIL and at.sum() > 2:
            yield Fault(
                share > MOST,
                int(at.argmax()) + 1,
                f"{share:.1%} of the readings are {end:g}, the end of the range; record it with "
                "more range or less signal",
            )


def _frozen(column: FloatArray) -> Iterator[Fault]:
    """Long runs of equal readings that are not at the end of the range."""
    ends = (column.min(), column.max())
    yield from _still(column, [run for run in still(column) if column[run.start] not in ends], "")


def held_against(angle: FloatArray, tension: FloatArray, rad_per_N: float) -> Iterator[Fault]:
    """An angle that stands still while the tension goes where only a turning drum brings it.

    Args:
        angle: As read, shape (samples,).
        tension: Same shape.
        rad_per_N: How far the drum turns for a change of the tension, at the least.
    """
    # So far that neither noise nor a step of the encoder can be meant.
    least = HELD * (step_of(angle) / rad_per_N + upper_rms(tension))
    stuck = [run for run in still(angle) if float(np.ptp(tension[run])) > least]
    yield from _still(angle, stuck, " while the tension moves")


def still(column: FloatArray) -> list[slice]:
    """The long runs of equal readings."""
    same = np.diff(column) == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    runs = zip(edges[::2].tolist(), (edges[1::2] + 1).tolist(), strict=True)
    return [slice(begin, end) for begin, end in runs if end - begin >= FROZEN]


def _still(column: FloatArray, runs: list[slice], meanwhile: str) -> Iterator[Fault]:
    if runs:
        lengths = [run.stop - run.start for run in runs]
        yield Fault(
            sum(lengths) / column.size > MOST,
            runs[0].start + 1,
            f"the readings stand still for {max(lengths)} samples{meanwhile}; check the sensor "
            "and its cable",
        )


def _dropouts(column: FloatArray) -> Iterator[Fault]:
    """Jumps to somewhere else and back again within a few samples."""
    change = np.diff(column)
    usual = max(float(np.quantile(np.abs(change), USUAL)), step_of(column))
    if not usual > 0.0:
        return
    jumps = np.flatnonzero(np.abs(change) > JUMP * usual)
    back = (np.diff(jumps) <= BACK) & (np.sign(change[jumps[1:]]) != np.sign(change[jumps[:-1]]))
    if back.any():
        row, count = int(jumps[:-1][back][0]) + 2, int(back.sum())
        yield Fault(
            count * BACK > MOST * column.size,
            row,
            f"the readings jump away and back {count} times; check the sensor and its cable",
        )


def shift_between(leader: FloatArray, follower: FloatArray) -> int:
    """Samples by which a channel lags one that it should be a straight line of; 0 if it does not.

    Args:
        leader: Shape (samples,).
        follower: Same shape; where it comes earlier, the answer is negative.
    """
    n = leader.size
    if n < 8 * SHIFTS or not (np.ptp(leader) > 0.0 and np.ptp(follower) > 0.0):
        return 0
    x = leader[SHIFTS : n - SHIFTS]
    left = np.empty(2 * SHIFTS + 1)
    for shift in range(-SHIFTS, SHIFTS + 1):
        y = follower[SHIFTS + shift : n - SHIFTS + shift]
        left[shift + SHIFTS] = 1.0 - np.corrcoef(x, y)[0, 1] ** 2
    best = int(left.argmin()) - SHIFTS
    inside = LEAST_SHIFT <= abs(best) < SHIFTS
    return best if inside and left.min() < BETTER**2 * left[SHIFTS] else 0
