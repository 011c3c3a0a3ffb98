"""Time stamps: an even grid of samples, in parts between gaps, and how it was reached."""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import BoolArray, FloatArray
from estune.recordings.column_names import MEASURED
from estune.recordings.issue import DataIssue, Unusable

GAP = 1.5
"""Interval of an even clock, relative to the usual one, above which a sample is missing."""
SCATTER_QUANTILE = 0.95
"""Quantile of the intervals' deviations that an uneven clock is known by: what is no further
beyond `GAP` than twice that is its jitter."""
BRIDGED = 3.0
"""Interval, relative to the usual one, that resampling bridges: two samples are interpolated."""
OFF_GRID = 0.5
"""Greatest deviation of a time stamp from the even grid, in samples, of rows taken as they are."""
JITTER = 0.1
"""Deviation that causes a warning, in samples."""
AGREES = 1e-3
"""Relative difference of two sampling rates that rounding explains."""
LATE = 1.5
"""Samples over which the slope of stamps may be off: a busy computer stamps one late."""
MOST_DECIMALS = 9
"""Most decimals of rounded time stamps."""
KEPT_MIN = 0.5
"""Share of the time that must be left beside the gaps."""
SAME_INSTANT = 1e-6
"""Difference of two instants, in samples, that rounding explains."""

COLUMN = "time_s"

Columns = Mapping[str, FloatArray]
"""Columns by name, each of shape (samples,)."""


class Evened(NamedTuple):
    """Columns on an even grid.

    Attributes:
        parts: The columns, `time_s` among them, of each stretch without a gap.
    """

    sampling_Hz: float
    parts: tuple[Columns, ...]
    issues: tuple[DataIssue, ...]


def evened(
    columns: Columns,
    time_s: FloatArray,
    stated_Hz: float | None,
    measured: tuple[str, ...] = MEASURED,
) -> Evened:
    """Columns with one time stamp for each row, on an even grid.

    Rows within half a sample of the grid are taken as they are; others are resampled. Rows that
    run backward are reversed, copies of the row above left out.

    Args:
        columns: Columns but time.
        time_s: Time stamps, finite, shape (samples,), three or more.
        stated_Hz: The rate the metadata names, or None.
        measured: Names of the columns that are interpolated; others are held.

    Raises:
        Unusable: stamps are out of order, or contradict the stated rate.
    """
    rows, issues = _in_order(columns, time_s)
    if issues:
        ordered = {name: values[rows] for name, values in columns.items()}
        try:
            found = evened(ordered, time_s[rows], stated_Hz, measured)
        except Unusable as error:
            raise error.among(rows) from None
        return found._replace(issues=(*issues, *(one.among(rows) for one in found.issues)))
    rounding_s = _rounding(time_s)
    if _is_counted(time_s, rounding_s):
        return _counted(columns, time_s, stated_Hz)
    _check_order(time_s)
    counts = _counts(time_s)
    if counts[-1] >= counts.size:
        found_Hz = _counted_rate(time_s, counts)
        if _off_grid(time_s, found_Hz, counts) <= JITTER:
            _check_rate(stated_Hz, found_Hz, AGREES)
            return _filled(columns, time_s, counts, stated_Hz or found_Hz, measured)
    gaps = _gaps(time_s, rounding_s)
    bounds = [0, *gaps.tolist(), time_s.size]
    whole_rows = [slice(a, b) for a, b in itertools.pairwise(bounds)]
    longest = max(whole_rows, key=lambda part: part.stop - part.start)
    found_Hz = _rate(time_s[longest])
    # One sample late in the middle turns the slope by 1.5 samples over all of them.
    tolerance = AGREES + (LATE + rounding_s * found_Hz) / (longest.stop - longest.start)
    _check_rate(stated_Hz, found_Hz, tolerance)
    off = max(_off_grid(time_s[part], found_Hz) for part in whole_rows)
    if off > OFF_GRID + rounding_s * found_Hz:
        return resampled(columns, dict.fromkeys(columns, time_s), stated_Hz, measured)
    issues = _gap_issues(time_s, gaps)
    if off > JITTER + rounding_s * found_Hz:
        sentence = (
            f"the time stamps scatter by {off:.2g} of a sample; the rows are taken as evenly"
        )
        issues.append(DataIssue("warning", f"{sentence} spaced", COLUMN))
    whole = {COLUMN: time_s, **columns}
    parts = tuple({name: values[part] for name, values in whole.items()} for part in whole_rows)
    return Evened(found_Hz if stated_Hz is None else stated_Hz, parts, tuple(issues))


def _in_order(columns: Columns, time_s: FloatArray) -> tuple[NDArray[np.intp], list[DataIssue]]:
    """Rows in the order of time without copies, and what was done; nothing where it does not help.

    Rows that share a stamp are copies where all of them are equal in every column: a stamp that is
    rounded to several samples has other values, too.
    """
    steps, issues = np.diff(time_s), list[DataIssue]()
    same: BoolArray = steps == 0.0
    equal = np.logical_and.reduce([values[1:] == values[:-1] for values in columns.values()])
    copies = np.flatnonzero(same) + 1 if (equal | ~same).all() else np.zeros(0, np.intp)
    rows = np.delete(np.arange(time_s.size), copies)
    if rows.size < 3:
        return rows, []
    if copies.size:
        count = "a row repeats" if copies.size == 1 else f"{copies.size} rows repeat"
        sentence = f"{count} the row above with its time, and the copies are left out"
        issues.append(DataIssue("warning", sentence, COLUMN, int(copies[0]) + 1))
    if (np.diff(time_s[rows]) < 0.0).all():
        rows = rows[::-1]
        issues.append(
            DataIssue("warning", "the rows begin with the last, and are reversed", COLUMN)
        )
    return rows, issues


def _filled(
    columns: Columns,
    time_s: FloatArray,
    counts: FloatArray,
    rate: float,
    measured: tuple[str, ...],
) -> Evened:
    """Rows of an even clock with one or two missing filled in, in parts between longer gaps."""
    every = np.arange(counts[-1] + 1.0)
    last = np.searchsorted(counts, every, side="right") - 1
    steps = np.append(np.diff(counts), 1.0)
    within = (counts[last] == every) | (steps[last] <= BRIDGED)
    whole = {COLUMN: np.interp(every, counts, time_s)} | {
        name: np.interp(every, counts, values) if name in measured else values[last]
        for name, values in columns.items()
    }
    bridged = np.flatnonzero((steps > 1.0) & (steps <= BRIDGED))
    issues = _gap_issues(time_s, np.flatnonzero(steps[:-1] > BRIDGED) + 1)
    if bridged.size:
        number = int((steps[bridged] - 1.0).sum())
        sentence = f"of an even clock of {rate:.6g} Hz {number} rows are missing, one or two "
        sentence += "in a row: measurements are interpolated there, commands held"
        issues.append(DataIssue("warning", sentence, COLUMN, int(bridged[0]) + 2))
    parts = tuple({name: values[part] for name, values in whole.items()} for part in _runs(within))
    return Evened(rate, parts, tuple(issues))


def resampled(
    columns: Columns,
    clocks: Columns,
    stated_Hz: float | None,
    measured: tuple[str, ...] = MEASURED,
) -> Evened:
    """Columns with stamps of their own on one grid, that of the first measured column.

    Measurements are interpolated linearly, commands held; nothing reaches beyond the ends of a
    measurement, nor across a gap in one.

    Args:
        columns: Columns but time, one of them measured.
        clocks: Time stamps of each column, same shape.
        stated_Hz: The rate the metadata names, or None for the usual one of the stamps.
        measured: Names of the columns that are interpolated; others are held.

    Raises:
        Unusable: stamps are out of order, contradict the stated rate, or leave too little.
    """
    lead = next(name for name in measured if name in columns)
    for stamps in clocks.values():
        _check_order(stamps)
    usual_s = 1.0 / _usual_rate(clocks[lead])
    _check_rate(stated_Hz, 1.0 / usual_s, JITTER)
    rate = stated_Hz or 1.0 / usual_s
    first = max(float(stamps[0]) for stamps in clocks.values())
    last = min(float(clocks[name][-1]) for name in columns if name in measured)
    begin = float(clocks[lead][np.searchsorted(clocks[lead], first)]) if first <= last else first
    grid = begin + np.arange(max(int((last - begin) * rate + SAME_INSTANT) + 1, 0)) / rate
    within = np.ones(grid.size, np.bool_)
    on_grid = {COLUMN: grid}
    for name, values in columns.items():
        if name in measured:
            on_grid[name] = np.interp(grid, clocks[name], values)
            within &= _within(grid, clocks[name])
        else:
            held = np.searchsorted(clocks[name], grid + SAME_INSTANT / rate, side="right") - 1
            on_grid[name] = values[held]
    if within.mean() < KEPT_MIN if grid.size else True:
        raise Unusable(
            "more than half of the time is without samples, or the stamps come in bursts; record "
            "the stamps of the device, not those of arrival",
            COLUMN,
        )
    parts = tuple({n: v[part] for n, v in on_grid.items()} for part in _runs(within))
    return Evened(
        rate,
        parts,
        tuple(_resampling_issues(clocks, lead, rate, last, len(parts), measured=measured)),
    )


def _resampling_issues(
    clocks: Columns,
    lead: str,
    rate: float,
    last_s: float,
    parts: int,
    *,
    measured: tuple[str, ...],
) -> list[DataIssue]:
    off = _off_grid(clocks[lead], rate, _counts(clocks[lead]))
    sentence = (
        f"resampled to {rate:.6g} Hz, the usual rate of {lead}, whose stamps are up to {off:.2g} "
        "samples off an even grid: measurements linearly, commands held"
    )
    if parts > 1:
        sentence += f"; split into {parts} parts at gaps"
    issues = [DataIssue("warning", sentence, COLUMN)]
    for name, stamps in clocks.items():
        if name not in measured and last_s - stamps[-1] > 1.0 / rate:
            early = f"it ends {last_s - stamps[-1]:.3g} s before the measurements; its last value"
            issues.append(DataIssue("warning", f"{early} is held", name))
    return issues


def _gap_issues(time_s: FloatArray, gaps: NDArray[np.intp]) -> list[DataIssue]:
    if not gaps.size:
        return []
    lost_s = float((time_s[gaps] - time_s[gaps - 1]).sum())
    sentence = (
        f"samples are missing in {gaps.size} {'gap' if gaps.size == 1 else 'gaps'}, {lost_s:.3g} "
        f"s of {time_s[-1] - time_s[0]:.4g} s; split into {gaps.size + 1} parts"
    )
    return [DataIssue("warning", sentence, COLUMN, int(gaps[0]) + 1)]


def _gaps(time_s: FloatArray, rounding_s: float) -> NDArray[np.intp]:
    """Rows before which samples are missing."""
    return np.flatnonzero(np.diff(time_s) > _longest_s(time_s, rounding_s)) + 1


def _longest_s(time_s: FloatArray, rounding_s: float) -> float:
    """Longest interval in which no sample is missing, s."""
    steps = np.diff(time_s)
    usual_s = float(np.median(steps))
    scatter_s = float(np.quantile(np.abs(steps - usual_s), SCATTER_QUANTILE))
    scatter_s = min(scatter_s, 0.5 * (BRIDGED - GAP) * usual_s)
    return GAP * usual_s + 2.0 * max(rounding_s, scatter_s)


def _within(grid: FloatArray, stamps: FloatArray) -> BoolArray:
    """Whether each instant lies between two stamps without a gap."""
    steps = np.diff(stamps)
    longest_s = BRIDGED * float(np.median(steps)) + 2.0 * _rounding(stamps)
    after = np.clip(np.searchsorted(stamps, grid), 1, stamps.size - 1)
    return np.asarray((steps[after - 1] <= longest_s) | (stamps[after] == grid))


def _is_counted(time_s: FloatArray, rounding_s: float) -> bool:
    """Whether stamps are rounded so far that rows share them, as an even clock's would."""
    steps = np.diff(time_s)
    repeated = bool((steps == 0.0).any()) and not (steps < 0.0).any()
    if not repeated or not time_s[-1] > time_s[0]:
        return False
    rate = _rate(time_s)
    return rounding_s > 0.0 and _off_grid(time_s, rate) <= 2.0 * rounding_s * rate + SAME_INSTANT


def _counted(columns: Columns, time_s: FloatArray, stated_Hz: float | None) -> Evened:
    """Rows of an even clock whose stamps are rounded to several samples."""
    found_Hz = _rate(time_s)
    _check_rate(stated_Hz, found_Hz, JITTER)
    rate = found_Hz if stated_Hz is None else stated_Hz
    k = np.arange(time_s.size) - (time_s.size - 1) / 2.0
    sentence = (
        f"the time stamps are rounded to {2.0 * _rounding(time_s):.3g} s, which several rows "
        f"share; the rows are taken as evenly spaced, {found_Hz:.6g} a second"
    )
    part = {COLUMN: time_s.mean() + k / rate, **columns}
    return Evened(rate, (part,), (DataIssue("warning", sentence, COLUMN),))


def _runs(mask: BoolArray) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]


def _rate(time_s: FloatArray) -> float:
    k = np.arange(time_s.size) - (time_s.size - 1) / 2.0
    return float((k @ k) / (k @ time_s)) if time_s.size > 1 else np.inf


def _off_grid(time_s: FloatArray, rate: float, counts: FloatArray | None = None) -> float:
    """Greatest deviation of stamps from the even grid that suits them best, in samples.

    Args:
        rate: Of the grid.
        counts: Samples of the grid that the stamps are of; by default all in turn.
    """
    k = np.arange(time_s.size) if counts is None else counts
    return float(np.abs(time_s - time_s.mean() - (k - k.mean()) / rate).max() * rate)


def _counts(time_s: FloatArray) -> FloatArray:
    """Samples of an even clock that the stamps are of, where some are missing."""
    steps = np.diff(time_s)
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.round(steps / np.median(steps)), 1.0))])


def _counted_rate(time_s: FloatArray, counts: FloatArray) -> float:
    """Rate by regression of stamps on the samples of an even clock that they are of."""
    k = counts - counts.mean()
    return float((k @ k) / (k @ (time_s - time_s.mean())))


def _usual_rate(time_s: FloatArray) -> float:
    """Rate of an even clock with rows missing, else that of the steps that are no gap.

    With stamps in whole seconds two rows lacking a value in 9000 moved the mean of the steps, and
    every row was interpolated: a loop that rang was told to be sound.
    """
    counts = _counts(time_s)
    rate = _counted_rate(time_s, counts)
    if _off_grid(time_s, rate, counts) <= JITTER:
        return rate
    steps = np.diff(time_s)
    return 1.0 / float(steps[steps <= _longest_s(time_s, _rounding(time_s))].mean())


def _check_order(time_s: FloatArray) -> None:
    backward = np.flatnonzero(np.diff(time_s) <= 0.0)
    if backward.size:
        row = int(backward[0]) + 2
        repeats = time_s[row - 1] == time_s[row - 2]
        raise Unusable(
            f"{time_s[row - 1]:g} s {'repeats the time of' if repeats else 'is before that of'} "
            "the row above; sort the rows and keep each time once",
            COLUMN,
            row,
        )


def _rounding(time_s: FloatArray) -> float:
    """Greatest rounding error of the stamps, s; 0 where they are not rounded."""
    close = 1e-12 * max(1.0, float(np.abs(time_s).max()))
    for decimals in range(MOST_DECIMALS + 1):
        if np.abs(np.round(time_s, decimals) - time_s).max() < close:
            return 0.5 * 10.0**-decimals
    return 0.0


def _check_rate(stated_Hz: float | None, found_Hz: float, tolerance: float) -> None:
    if stated_Hz is not None and abs(stated_Hz / found_Hz - 1.0) > tolerance:
        raise Unusable(_contradiction(stated_Hz, found_Hz), COLUMN)


def _contradiction(stated_Hz: float, found_Hz: float) -> str:
    sentence = f"sampling_Hz is {stated_Hz:g}, the time column says {found_Hz:.6g} Hz"
    for unit, per_second in (("ms", 1e3), ("us", 1e6), ("min", 1.0 / 60.0)):
        if abs(stated_Hz / found_Hz / per_second - 1.0) < 0.1:
            return f"{sentence}: the time seems to be in {unit}; give it in seconds"
    return f"{sentence}; correct the one that is wrong"
