"""Whether prediction errors are white."""

import math
from collections.abc import Iterator

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
    from scipy.special import chdtrc, gammaincc  # noqa: PLC0415  slow to import

    rows = list(rows_of(signals, errors))
    power = float(errors @ errors) / errors.size
    if power <= signals.resolution**2:
        return True
    moments, lines = np.zeros(LAGS), []
    for row in rows:
        lags = min(LAGS, row.shape[1] - 1)
        for lag in range(1, lags + 1):
            moments[lag - 1] += float(np.vdot(row[:, lag:], row[:, :-lag]))
        spectrum = np.abs(np.fft.rfft(row, axis=1))[:, 1:-1] ** 2 / row.shape[1]
        lines.append((spectrum.sum(axis=0), row.shape[0]))
    portmanteau = float(np.sum((moments / (power * math.sqrt(errors.size))) ** 2))
    if chdtrc(LAGS, portmanteau) < CHANCE:
        return False
    return all(
        gammaincc(count, float(line.max()) / power) * line.size > CHANCE for line, count in lines
    )


def rows_of(signals: FitSignals, errors: FloatArray) -> Iterator[FloatArray]:
    """Errors of each group, shape (records, samples)."""
    at = 0
    for group in signals.groups:
        shape = (len(group.members), group.effort.shape[1] - group.history)
        yield errors[at : at + shape[0] * shape[1]].reshape(shape)
        at += shape[0] * shape[1]
