"""What any linear loop foretells of the errors of a fit, from the past of effort and measurement.

A model of load, drift and colour is never quite that of the noise: with noise at the plant's input
its errors are white by every test and yet follow the past a little, and what follows the past a
little passes for friction in a log that is long enough (9 of 9 linear logs of 6 to 24 h). So a law
that is not linear has to explain what a long linear predictor leaves. That is noise which no past
foretells, whatever its colour, in open loop and in closed. What a linear model lacks answers the
setpoint besides, and is as little a law of motion (`linear_answers`).
"""

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import delayed
from estune.loop_model.fit_signals import FitSignals

MEANS_FROM, MEANS_TO = 4, 4.0
"""The means are over 2^4 samples, 2^5 and so on, to four settling times."""

ANSWERS, ANSWERED = 12, 1.0 / 3.0
"""Delays of the model's answer to the setpoint that are known, and settling times that they
reach. Without them four of five logs of 21 600 samples of a linear chamber with coloured noise,
whose dead time was fitted a sample long, change with their motion, at probabilities of 1e-21 to
4e-4; with them none does, at 0.05 to 0.6. With twice the reach it is 3e-6 and 0.007 in two;
with Laguerre functions of the setpoint in their place 5e-4 in one."""

APART = 1e-7
"""Least share of the largest singular value by which columns differ."""

BLOCK = 1 << 14
"""Samples that are decomposed at a time."""

MOST = 128
"""Columns that there is room for: a settling time of 2^30 samples has 100 beside the slopes of the
model. Those that are not used take no memory."""


def linear_past(signals: FitSignals, lags: int) -> Iterator[FloatArray]:
    """The past of effort and measurement behind each residual, columns of shape (residuals,).

    Args:
        lags: Samples before that are known one by one; beyond them exponential means are.
    """
    longest = max(MEANS_TO * signals.settling_samples, 2.0 ** (MEANS_FROM + 1))
    spans = 2.0 ** np.arange(MEANS_FROM, math.floor(math.log2(longest)) + 1)
    efforts = [group.effort for group in signals.groups]
    measurements = [group.measurement for group in signals.groups]
    for moved in ([one - one[:, :1] for one in of] for of in (efforts, measurements)):
        for lag in range(1, lags + 1):
            yield _column(signals, (delayed(one, lag) for one in moved))
        for span in spans:
            b, a = [-math.expm1(-1.0 / span)], [1.0, -math.exp(-1.0 / span)]
            yield _column(signals, (lfilter(b, a, delayed(one, 1)) for one in moved))


def linear_answers(
    signals: FitSignals, answers: Sequence[tuple[FloatArray, FloatArray]]
) -> Iterator[FloatArray]:
    """What a linear loop may still answer to its setpoint, columns of shape (residuals,).

    Args:
        answers: Output and effort by which the model answers the setpoint of each record.
    """
    lags = np.unique(np.linspace(0.0, ANSWERED * signals.settling_samples, ANSWERS + 1).round())
    for k in (0, 1):
        of = [np.stack([answers[i][k] for i in group.members]) for group in signals.groups]
        for lag in lags:
            yield _column(signals, (delayed(x - x[:, :1], int(lag)) for x in of))


def _column(signals: FitSignals, parts: Iterable[FloatArray]) -> FloatArray:
    """A signal of each group as one column behind the histories, less its mean."""
    groups = zip(signals.groups, parts, strict=True)
    column = np.concatenate([part[:, group.history :].ravel() for group, part in groups])
    column -= column.mean()
    return np.asarray(column)


def orthonormal(samples: int, columns: Iterable[FloatArray]) -> FloatArray:
    """Orthonormal basis of what columns of so many samples span, whatever their sizes.

    By the triangle of their QR decomposition, block after block: a decomposition of all at once
    has four copies of them, 4 GB with two million samples.
    """
    whole, count = np.empty((samples, MOST), order="F"), 0
    for column in columns:
        whole[:, count] = column / max(float(np.linalg.norm(column)), 1e-300)
        count += 1
    whole = whole[:, :count]
    _, sizes, axes = np.linalg.svd(_triangle(whole), full_matrices=False)
    kept = sizes > APART * sizes[0]
    basis = _turned(whole, axes[kept].T / sizes[kept])
    # Of columns that hardly differ it is orthonormal to 1e-9 only.
    return _turned(basis, np.asarray(np.linalg.inv(_triangle(basis)), float))


def _triangle(columns: FloatArray) -> FloatArray:
    """R of the QR decomposition of columns."""
    found = np.empty((0, columns.shape[1]))
    for start in range(0, len(columns), BLOCK):
        block = np.vstack([found, columns[start : start + BLOCK]])
        found = np.asarray(np.linalg.qr(block, mode="r"))
    return found


def _turned(columns: FloatArray, by: FloatArray) -> FloatArray:
    """Columns times a matrix with as many columns or fewer, in their place."""
    for start in range(0, len(columns), BLOCK):
        part = slice(start, start + BLOCK)
        columns[part, : by.shape[1]] = columns[part] @ by
    return columns[:, : by.shape[1]]


def less(values: FloatArray, basis: FloatArray) -> FloatArray:
    """Values without their part in an orthonormal basis."""
    return np.asarray(values - basis @ (basis.T @ values))
