"""Reports on change: values that are logged when they change, at times of their own."""

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.timing import COLUMN, Columns, Evened

_OFF, _OFTEN = 0.5, 0.2
"""A clock is uneven where a fifth of its intervals differ by half from the usual one: a logger's
jitter is below 0.1, and its gaps are fewer."""
_REPEATED_MAX = 0.02
"""Share of values that repeat the one before, above which they are samples."""
_ROWS_MAX = 100
"""Instants for each report at most: a burst of reports would ask for a grid without end."""


def are_reports(values: FloatArray, stamps: FloatArray) -> bool:
    """Whether values were logged when they changed, rather than sampled."""
    if stamps.size < 3:
        return True
    steps = np.diff(stamps)
    usual_s = float(np.median(steps))
    uneven = float(np.mean(np.abs(steps - usual_s) > _OFF * usual_s)) > _OFTEN
    return uneven and float(np.mean(np.diff(values) == 0.0)) <= _REPEATED_MAX


def held(columns: Columns, clocks: Columns, stated_Hz: float | None) -> Evened:
    """Reports on one even grid, each held until the next.

    The measurement runs into a new value within the usual interval, as it was measured in between
    and had not changed before.

    Args:
        columns: Columns, `measurement` among them, shape (reports,) each.
        clocks: Their stamps, s, ascending.
        stated_Hz: Rate of the grid; by default that of the usual interval of the measurement.

    Raises:
        Unusable: they do not overlap, or come in bursts.
    """
    stamps, values = clocks["measurement"], columns["measurement"]
    steps = np.diff(stamps)
    usual_s = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else np.nan
    rate = stated_Hz or 1.0 / usual_s
    first = max(float(clock[0]) for clock in clocks.values())
    last = float(stamps[-1])
    rows = (last - first) * rate + 1.0
    if not 1.0 < rows <= _ROWS_MAX * sum(clock.size for clock in clocks.values()):
        raise Unusable(
            "the reports do not overlap in time, or come in bursts; record with an even interval",
            COLUMN,
        )
    grid = first + np.arange(int(rows)) / rate
    late = np.flatnonzero(steps > 1.5 * usual_s)
    knots = np.concatenate([stamps, stamps[late + 1] - usual_s])
    order = np.argsort(knots, kind="stable")
    ends = np.concatenate([values, values[late]])
    on_grid = {COLUMN: grid, "measurement": np.interp(grid, knots[order], ends[order])}
    for name, own in columns.items():
        if name != "measurement":
            place = np.searchsorted(clocks[name], grid + 1e-6 / rate, side="right") - 1
            on_grid[name] = own[place]
    said = (
        f"the values are reports on change; brought to {rate:.4g} Hz, the usual interval of the "
        "measurement, each held until the next"
    )
    return Evened(rate, (on_grid,), (DataIssue("warning", said, COLUMN),))
