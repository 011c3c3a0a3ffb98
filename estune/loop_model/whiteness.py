"""Whether prediction errors are white."""

from collections.abc import Iterator, Sequence

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.least_squares import FitSignals

LAGS = 20
"""Lags of the autocorrelation by which prediction errors are judged to be white."""

CHANCE = 1e-3
"""Probability that white errors are taken for coloured; then the search costs time, and the
criterion still decides."""


def is_white(signals: FitSignals, errors: FloatArray) -> bool:
    """Whether prediction errors are white, by their autocorrelation and their largest line."""
    from scipy.special import gammaincc  # noqa: PLC0415  slow to import

    rows = list(rows_of(signals, errors))
    power = float(errors @ errors) / errors.size
    if power <= signals.resolution**2:
        return True
    if _is_correlated(rows):
        return False
    lines = []
    for row in rows:
        spectrum = np.abs(np.fft.rfft(row, axis=1))[:, 1:-1] ** 2 / row.shape[1]
        lines.append((spectrum.sum(axis=0), row.shape[0]))
    return all(
        gammaincc(count, float(line.max()) / power) * line.size > CHANCE for line, count in lines
    )


def is_disturbed(signals: FitSignals, errors: FloatArray) -> bool:
    """Whether a load or drift acts in trials from rest, by what is not white before their steps.

    There nothing answers a step that the model does not explain. Both the errors and the
    measurement have to show it: a loop feeds its noise back, and a drum that friction holds does
    not follow the effort as the model does. A mean is no sign: the offsets of a record take up
    what the model leaves after its step.
    """
    of_errors, of_measurement = list[FloatArray](), list[FloatArray]()
    for row, group in zip(rows_of(signals, errors), signals.groups, strict=True):
        if group.rest >= 2 * LAGS:
            for rows, of in ((row, of_errors), (group.measurement, of_measurement)):
                before = rows[:, : group.rest]
                of.append(before - before.mean(axis=1, keepdims=True))
    power = sum(float(np.vdot(row, row)) for row in of_errors)
    if not power > signals.resolution**2 * sum(row.size for row in of_errors):
        return False
    return _is_correlated(of_errors) and _is_correlated(of_measurement)


def _is_correlated(rows: Sequence[FloatArray]) -> bool:
    """Whether rows have an autocorrelation, by the test of Box and Pierce."""
    from scipy.special import chdtrc  # noqa: PLC0415  slow to import

    moments = np.zeros(LAGS)
    for row in rows:
        for lag in range(1, min(LAGS, row.shape[1] - 1) + 1):
            moments[lag - 1] += float(np.vdot(row[:, lag:], row[:, :-lag]))
    squares = sum(float(np.vdot(row, row)) for row in rows)
    if not squares:  # a sensor that rounds reads the same at rest: 0 / 0 would warn
        return False
    portmanteau = sum(row.size for row in rows) * float(np.sum((moments / squares) ** 2))
    return bool(chdtrc(LAGS, portmanteau) < CHANCE)


def rows_of(signals: FitSignals, errors: FloatArray) -> Iterator[FloatArray]:
    """Errors of each group, shape (records, samples)."""
    at = 0
    for group in signals.groups:
        shape = (len(group.members), group.effort.shape[1] - group.history)
        yield errors[at : at + shape[0] * shape[1]].reshape(shape)
        at += shape[0] * shape[1]
