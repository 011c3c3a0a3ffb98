"""Whether prediction errors are white."""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals

LAGS = 20
"""Lags of the autocorrelation by which prediction errors are judged to be white."""

CHANCE = 1e-3
"""Probability that white errors are taken for coloured; then the search costs time, and the
criterion still decides."""

CONTRADICTED = 10.0
"""Very strong evidence. By it loads of 0.3 and 1 % of the step reached 9.0 at most, in one to five
trials of three plants of `experiments.batch`; friction in the eyelet of a reel 13.9 and 114."""


def is_white(signals: FitSignals, errors: FloatArray) -> bool:
    """Whether prediction errors are white, by their autocorrelation and their largest line."""
    from scipy.special import gammaincc  # noqa: PLC0415  slow to import

    rows = list(signals.split(errors))
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


def beyond_chance(samples: int) -> float:
    """Ratio of the powers of so much white noise, five deviations above one, that none reaches."""
    return 1.0 + 5.0 * math.sqrt(2.0 / samples)


def is_contradicted(signals: FitSignals, errors: FloatArray) -> bool:
    """Whether trials from rest contradict a load before their steps, where nothing answers these.

    A load predicts the measurement from what it was. Where that is worse there than its mean by
    `CONTRADICTED` in twice the logarithm of the likelihood, no load acts.
    """
    of_errors, of_mean, count = 0.0, 0.0, 0
    for row, group in zip(signals.split(errors), signals.groups, strict=True):
        before = group.measurement[:, : group.rest]
        if group.rest > 1:
            of_errors += float(np.sum(row[:, : group.rest] ** 2))
            of_mean += float(np.sum((before - before.mean(axis=1, keepdims=True)) ** 2))
            count += before.size
    least = count * signals.resolution**2
    if not least:
        return False
    return count * math.log((of_errors + least) / (of_mean + least)) > CONTRADICTED


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
