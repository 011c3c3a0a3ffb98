"""The unit of a time that nobody stated: epochs by their size, and doubts about the rest."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.recordings.channel_search import option
from estune.recordings.issue import DataIssue
from estune.support.quantity_text import time_text

_EPOCH_S = (1.0e9, 4.2e9)
"""Seconds since 1970 from 2001 to 2103; in ms, us and ns the ranges do not overlap."""
_EPOCHS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}

_LOGGED_EVERY_S = tuple(60.0 * m for m in (0.5, 1, 2, 3, 4, 5, 10, 15, 20, 30, 60, 120, 360, 1440))
"""Intervals in which historians log, s: half a minute to a day."""
_SECOND_S, _FINE = 1.0, 1e-3
"""Steps below a second are seconds: of milliseconds they would be a loop above 1 kHz."""


def epoch_unit(values: NDArray[Any]) -> str:
    """The unit in which numbers are times since 1970; empty where they are not."""
    if values.dtype.kind not in "iuf" or not values.size or not np.isfinite(values[0]):
        return ""
    first = float(values[0])
    low, high = _EPOCH_S
    return next((u for u, per_s in _EPOCHS.items() if low <= first / per_s <= high), "")


def time_doubt(
    name: str, values: NDArray[Any], time_s: FloatArray, *, slow: bool = False
) -> DataIssue | None:
    """A doubt about a time without a unit, which is read as seconds; None where it may be so.

    Args:
        name: Name of the channel.
        values: As the file has them.
        time_s: As they were read, s.
        slow: Whether the measurement is one that is sampled once a second, a temperature.
    """
    if values.dtype.kind not in "iuf" or time_s.size < 2 or epoch_unit(values):
        return None
    step_s = float(np.median(np.diff(time_s)))
    near = any(abs(step_s / usual - 1.0) < 0.01 for usual in _LOGGED_EVERY_S)
    usual_s = _SECOND_S * (1.0 + _FINE) if slow else _SECOND_S * (1.0 - _FINE)
    if near or not step_s >= usual_s:
        return None
    return DataIssue(
        "doubt",
        f"{name} has no unit and is read as seconds: a sample every {time_text(step_s)}, where "
        f"{step_s:.4g} ms is more usual; {option('time', f'{name}[ms]')} if it is in ms, "
        f"{option('time', f'{name}[s]')} if in seconds",
        "time",
    )
