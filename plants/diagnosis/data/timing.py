"""The time column: whether it is an even grid, and whether it agrees with the sampling rate."""

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import Unusable

GAP = 1.5
"""Interval, relative to the usual one, above which a sample is missing."""
OFF_GRID = 0.5
"""Greatest deviation of a time stamp from the even grid, in samples."""
JITTER = 0.1
"""Deviation that causes a warning, in samples."""
AGREES = 1e-3
"""Relative difference of two sampling rates that rounding explains."""
MOST_DECIMALS = 9
"""Most decimals of rounded time stamps."""

COLUMN = "time_s"


def sampling_rate(time_s: FloatArray, stated_Hz: float | None) -> tuple[float, str | None]:
    """The sampling rate of a time column, and a warning where the stamps scatter.

    Args:
        time_s: Time stamps, finite, shape (samples,), three or more.
        stated_Hz: The rate the metadata names, or None.

    Returns:
        The rate, the stated one where there is one, and a sentence or None.

    Raises:
        Unusable: stamps are out of order, missing, irregular, or contradict the stated rate.
    """
    rounding_s = _rounding(time_s)
    _check_order(time_s, rounding_s)
    k = np.arange(time_s.size) - (time_s.size - 1) / 2.0
    found_Hz = float((k @ k) / (k @ time_s))
    tolerance = AGREES + rounding_s * found_Hz / time_s.size
    if stated_Hz is not None and abs(stated_Hz / found_Hz - 1.0) > tolerance:
        raise Unusable(_contradiction(stated_Hz, found_Hz), COLUMN)
    off = np.abs(time_s - time_s.mean() - k / found_Hz) * found_Hz
    if off.max() > OFF_GRID + rounding_s * found_Hz:
        raise Unusable(
            f"the time stamps are irregular, {off.max():.2g} samples off an even grid; resample "
            "the record evenly",
            COLUMN,
            int(off.argmax()) + 1,
        )
    warning = None
    if off.max() > JITTER + rounding_s * found_Hz:
        warning = (
            f"the time stamps scatter by {off.max():.2g} of a sample; the rows are taken as "
            "evenly spaced"
        )
    return (found_Hz if stated_Hz is None else stated_Hz), warning


def _check_order(time_s: FloatArray, rounding_s: float) -> None:
    steps = np.diff(time_s)
    backward = np.flatnonzero(steps <= 0.0)
    if backward.size:
        row = int(backward[0]) + 2
        what = "repeats the time of" if steps[row - 2] == 0.0 else "is before that of"
        raise Unusable(
            f"{time_s[row - 1]:g} s {what} the row above; sort the rows and keep each time once",
            COLUMN,
            row,
        )
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * usual + 2.0 * rounding_s)
    if gaps.size:
        row = int(gaps[0]) + 2
        raise Unusable(
            f"{steps[row - 2]:.6g} s pass before this row, {usual:.6g} s elsewhere: samples are "
            "missing; cut the record there or resample it evenly",
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


def _contradiction(stated_Hz: float, found_Hz: float) -> str:
    sentence = f"sampling_Hz is {stated_Hz:g}, the time column says {found_Hz:.6g} Hz"
    for unit, per_second in (("ms", 1e3), ("us", 1e6), ("min", 1.0 / 60.0)):
        if abs(stated_Hz / found_Hz / per_second - 1.0) < 0.1:
            return f"{sentence}: the time seems to be in {unit}; give it in seconds"
    return f"{sentence}; correct the one that is wrong"
