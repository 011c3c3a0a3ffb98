"""Faults that a sensor's column shows by itself: a rail, a frozen reading, a dropout, a shift."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.noise import step_of, upper_rms
from plants.diagnosis.data.periods import runs


def faults(column: str, readings: FloatArray) -> Iterator[DataIssue]:
    """The faults of a sensor's readings, shape (samples,)."""
    step = step_of(readings)
    if upper_rms(readings) > step:  # else readings rest on a step of the converter
        still = _constant_runs(readings)
        if column == "angle_rad":  # of a drive that friction holds, anywhere
            still = [run for run in still if _jumps(readings, run.stop, step)]
        else:
            yield from _at_rail(column, readings)
            ends = (readings.min(), readings.max())
            still = [run for run in still if readings[run.start] not in ends]
        yield from _frozen(column, readings.size, still, "")
    yield from _dropouts(column, readings)


def _jumps(readings: FloatArray, at: int, step: float) -> bool:
    """Whether a position has gone on while its reading stood still, unlike one that was held."""
    after = np.abs(np.diff(readings[at - 1 : at + 2]))
    return after.size == 2 and bool(after[0] > CONSTANTS.above_noise * max(after[1], step))


def frozen_angle(
    angle: FloatArray, tension: FloatArray, rad_per_N: float, step_rad: float
) -> Iterator[DataIssue]:
    """An angle that stands still while the tension moves as only a turning drum can move it.

    Args:
        angle: As read, shape (samples,).
        tension: Same shape.
        rad_per_N: How far the drum turns for a change of the tension, at the least.
        step_rad: Step of the encoder.
    """
    # So far that neither noise nor a step of the encoder can be meant.
    least = 12.0 * (step_rad / rad_per_N + upper_rms(tension))
    still = [run for run in _constant_runs(angle) if float(np.ptp(tension[run])) > least]
    yield from _frozen("angle_rad", angle.size, still, " while the tension moves")


def _fault(lost: float, column: str, row: int, sentence: str) -> DataIssue:
    """A fault that loses a share of the record; one that loses most of it is refused."""
    return DataIssue("refused" if lost > 0.5 else "warning", sentence, column, row)


def _at_rail(column: str, readings: FloatArray) -> Iterator[DataIssue]:
    """The greatest or the least reading comes again and again, in spite of the noise."""
    for end in (readings.min(), readings.max()):
        at = readings == end
        share = float(at.mean())
        if share >= CONSTANTS.small**2 and at.sum() > 2:
            sentence = (
                f"{share:.1%} of the readings are {end:g}, the end of the range; record it with "
                "more range or less signal"
            )
            yield _fault(share, column, int(at.argmax()) + 1, sentence)


def _constant_runs(readings: FloatArray) -> list[slice]:
    """The runs of equal readings that are longer than chance makes them.

    Two readings of a noise of one step are equal with a probability of 1/(2 sqrt(pi)).
    """
    chance = math.erfc(CONSTANTS.clear / math.sqrt(2.0)) / readings.size
    longest = 1.0 - math.log(chance) / math.log(2.0 * math.sqrt(math.pi))
    equal = [slice(run.start, run.stop + 1) for run in runs(np.diff(readings) == 0.0)]
    return [run for run in equal if run.stop - run.start > longest]


def _frozen(column: str, samples: int, still: list[slice], when: str) -> Iterator[DataIssue]:
    if still:
        lengths = [run.stop - run.start for run in still]
        duration = f"the readings stand still for {max(lengths)} samples{when}"
        sentence = f"{duration}; check the sensor and its cable"
        yield _fault(sum(lengths) / samples, column, still[0].start + 1, sentence)


def _dropouts(column: str, readings: FloatArray) -> Iterator[DataIssue]:
    """Jumps far above the usual ones to somewhere else, and back within a few samples."""
    change = np.diff(readings)
    usual = max(float(np.quantile(np.abs(change), 0.99)), step_of(readings))
    if not usual > 0.0:
        return
    jumps = np.flatnonzero(np.abs(change) > CONSTANTS.clear * usual)
    longest = 5
    back = np.diff(jumps) <= longest
    back &= np.sign(change[jumps[1:]]) != np.sign(change[jumps[:-1]])
    if back.any():
        row, count = int(jumps[:-1][back][0]) + 2, int(back.sum())
        sentence = f"the readings jump away and back {count} times; check the sensor and its cable"
        yield _fault(count * longest / readings.size, column, row, sentence)


def shift_between(leader: FloatArray, follower: FloatArray) -> int:
    """Samples by which a channel lags another that it should be proportional to; 0 if it does not.

    Args:
        leader: Shape (samples,).
        follower: Same shape; where it comes earlier, the answer is negative.
    """
    n, most = leader.size, 20
    if n - 2 * most < CONSTANTS.fewest or not np.ptp(leader[most : n - most]) > 0.0:
        return 0
    x = leader[most : n - most]
    unexplained = np.ones(2 * most + 1)
    for shift in range(-most, most + 1):
        y = follower[most + shift : n - most + shift]
        if np.ptp(y) > 0.0:  # else there is no correlation
            unexplained[shift + most] = 1.0 - np.corrcoef(x, y)[0, 1] ** 2
    best = int(unexplained.argmin()) - most
    inside = 2 <= abs(best) < most
    # A shift is believed that leaves less than a tenth of what there is without one.
    return best if inside and unexplained.min() < CONSTANTS.small * unexplained[most] else 0
