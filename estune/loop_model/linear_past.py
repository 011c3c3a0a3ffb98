"""What any linear loop foretells of the errors of a fit, from the past of effort and measurement.

A model of load, drift and colour is never quite that of the noise: with noise at the plant's input
its errors are white by every test and yet follow the past a little, and what follows the past a
little passes for friction in a log that is long enough (9 of 9 linear logs of 6 to 24 h). So a law
that is not linear has to explain what a long linear predictor leaves. That is noise which no past
foretells, whatever its colour, in open loop and in closed. What a linear model lacks answers the
setpoint besides, and is as little a law of motion (`linear_answers`).
"""

import math
from collections.abc import Sequence

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


def linear_past(signals: FitSignals, lags: int) -> FloatArray:
    """The past of effort and measurement behind each residual, shape (residuals, columns).

    Args:
        lags: Samples before that are known one by one; beyond them exponential means are.
    """
    longest = max(MEANS_TO * signals.settling_samples, 2.0 ** (MEANS_FROM + 1))
    spans = 2.0 ** np.arange(MEANS_FROM, math.floor(math.log2(longest)) + 1)
    rows = []
    for group in signals.groups:
        columns = []
        for signal in (group.effort, group.measurement):
            moved = signal - signal[:, :1]
            before = delayed(moved, 1)
            columns += [delayed(moved, lag) for lag in range(1, lags + 1)]
            columns += [
                lfilter([-math.expm1(-1.0 / span)], [1.0, -math.exp(-1.0 / span)], before)
                for span in spans
            ]
        rows.append(np.stack([one[:, group.history :].ravel() for one in columns], axis=1))
    X = np.concatenate(rows)
    return np.asarray(X - X.mean(axis=0))


def linear_answers(
    signals: FitSignals, answers: Sequence[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """What a linear loop may still answer to its setpoint, shape (residuals, columns).

    Args:
        answers: Output and effort by which the model answers the setpoint of each record.
    """
    lags = np.unique(np.linspace(0.0, ANSWERED * signals.settling_samples, ANSWERS + 1).round())
    rows = []
    for group in signals.groups:
        pair = (np.stack([answers[i][k] for i in group.members]) for k in (0, 1))
        columns = [delayed(x - x[:, :1], int(lag)) for x in pair for lag in lags]
        rows.append(np.stack([one[:, group.history :].ravel() for one in columns], axis=1))
    X = np.concatenate(rows)
    return np.asarray(X - X.mean(axis=0))


def orthonormal(columns: FloatArray) -> FloatArray:
    """Orthonormal basis of what columns span, whatever their sizes."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(basis[:, sizes > APART * sizes[0]])


def less(values: FloatArray, basis: FloatArray) -> FloatArray:
    """Values without their part in an orthonormal basis."""
    return np.asarray(values - basis @ (basis.T @ values))
