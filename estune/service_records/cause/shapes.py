"""Shapes of the swings of a loop: what a limit cycle of a sticking actuator looks like."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.loop_signals import JudgedSignals, swings

SHORTEST = 8
"""Samples of a swing whose shape is told."""


class Shapes(NamedTuple):
    """Of the swings of the output.

    Attributes:
        curved: Share of what a straight line leaves of them, against half a cosine (He et al.
            2007): 0.1 for triangles, 0.9 for sines.
        moving: Variance of the measurement within swings over its variance: 0 where it rests
            while the output travels.
        offset: Mean error of a swing over its deviation within it: large for a square wave.
        together: Correlation of output and measurement, with the sign of the plant.
        returns: Correlation of the error one period later.
        later: The same four periods later, over that of one.
    """

    curved: float
    moving: float
    offset: float
    together: float
    returns: float
    later: float


def shapes(signals: JudgedSignals, sign: float, noise: float) -> Shapes:
    """Shapes of a log; noise is the deviation of the white part of the measurement."""
    y, u, error = signals.measurement, signals.output, signals.error
    found, weights = list[tuple[float, float, float]](), list[float]()
    for swing in swings(u):
        length = swing.stop - swing.start
        if length < SHORTEST:
            continue
        by = max(1, length // 8)
        parts = length // by
        at = slice(swing.start, swing.start + parts * by)
        mean_y, mean_e = (x[at].reshape(parts, by).mean(axis=1) for x in (y, error))
        inner = float(np.var(mean_y[1:-1])) - noise**2 / by
        offset = abs(float(mean_e.mean())) / (
            float(mean_e.std()) + 1e-12 * (float(np.ptp(y)) or 1.0)
        )
        found.append((_curved(u[swing]), max(inner, 0.0), min(offset, 10.0)))
        weights.append(abs(float(u[swing.stop] - u[swing.start])))
    variance = max(float(np.var(y)) - noise**2, 1e-300)
    curved, moving, offset = (
        np.average(np.array(found), axis=0, weights=weights)
        if found and sum(weights)
        else (0.5, variance, 1.0)
    )
    together = float(np.corrcoef(u, y)[0, 1]) if np.ptp(u) and np.ptp(y) else 0.0
    returns, later = _returns(error)
    return Shapes(
        float(curved),
        min(float(moving / variance), 2.0),
        float(offset),
        sign * together,
        returns,
        later,
    )


def _curved(u: FloatArray) -> float:
    x = np.linspace(0.0, 1.0, u.size)
    line = float(np.polynomial.Polynomial.fit(x, u, 1, full=True)[1][0].sum())
    wave = float(np.polynomial.Polynomial.fit(np.cos(np.pi * x), u, 1, full=True)[1][0].sum())
    return line / (line + wave + 1e-300)


def _returns(error: FloatArray) -> tuple[float, float]:
    """Correlation one period later, and that of four periods later over it."""
    x = error - error.mean()
    size = 2 * x.size
    power = np.abs(np.fft.rfft(x, size)) ** 2
    correlation = np.fft.irfft(power)[: x.size // 2]
    correlation /= correlation[0] + 1e-300
    below = np.flatnonzero(correlation < 0.0)
    if not below.size:
        return 0.0, 0.0
    begin = int(below[0])
    period = begin + int(np.argmax(correlation[begin:]))
    first = float(correlation[period])
    near = correlation[int(3.7 * period) : int(4.3 * period) + 1]
    return first, float(near.max()) / first if near.size and first > 0.0 else 0.0
