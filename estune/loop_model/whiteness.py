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


def is_disturbed(signals: FitSignals, errors: FloatArray) -> bool:
    """Whether a load or drift acts in trials from rest, by what is not white before their steps.

    There nothing answers a step that the model does not explain. Both the errors and the
    measurement have to show it: a loop feeds its noise back, and a drum that friction holds does
    not follow the effort as the model does.
    """
    rows = list(rows_of(signals, errors))
    seen = [group.measurement for group in signals.groups]
    return all(_is_coloured_before(signals, of) for of in (rows, seen))


def _is_coloured_before(signals: FitSignals, rows: list[FloatArray]) -> bool:
    """Whether rows of each group are not white before the steps, but for a mean of each.

    The offsets of a record take up what the model leaves after its step.
    """
    from scipy.special import chdtrc  # noqa: PLC0415  slow to import

    moments, power, count = np.zeros(LAGS), 0.0, 0
    for row, group in zip(rows, signals.groups, strict=True):
        before = row[:, : group.rest]
        if group.rest < 2 * LAGS:
            continue
        before = before - before.mean(axis=1, keepdims=True)
        power, count = power + float(np.vdot(before, before)), count + before.size
        for lag in range(1, LAGS + 1):
            moments[lag - 1] += float(np.vdot(before[:, lag:], before[:, :-lag]))
    if not power > count * signals.resolution**2:
        return False
    portmanteau = count * float(np.sum((moments / power) ** 2))
    return bool(chdtrc(LAGS, portmanteau) < CHANCE)


def rows_of(signals: FitSignals, errors: FloatArray) -> Iterator[FloatArray]:
    """Errors of each group, shape (records, samples)."""
    at = 0
    for group in signals.groups:
        shape = (len(group.members), group.effort.shape[1] - group.history)
        yield errors[at : at + shape[0] * shape[1]].reshape(shape)
        at += shape[0] * shape[1]
