"""Whether a response oscillates with a growing amplitude: then the loop is unstable.

The end of a response to one change of setpoint or load is fitted by

    y(t) = exp(s t) (a cos(w t) + b sin(w t)) + polynomial + noise,

which is linear in a, b and the polynomial. The polynomial takes up the approach to the setpoint
and a drift. The oscillation grows where s is above zero by more than its standard error explains,
and a few periods are alike but for their growth: friction's limit cycle has unlike swings.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray


class OscillationFit(NamedTuple):
    """How a stretch is fitted.

    Attributes:
        share: Last share of the response that is fitted: before, the answer to the change is left.
        degree: Of the polynomial.
        least: Fewest periods, so that the polynomial is none of them.
        most: Most periods; where the polynomial can follow the approach, it should.
    """

    share: float
    degree: int
    least: float
    most: float = math.inf


FITS = (
    OscillationFit(0.75, 3, 1.5),
    OscillationFit(0.5, 3, 1.5),
    OscillationFit(0.75, 1, 0.7, 3.0),
    OscillationFit(0.5, 1, 0.7, 3.0),
)
"""Of 450 trials that had no part in their choice these name 126 of 161 unstable ones, and none of
the others (`python -m experiments.growing_oscillations`); of the 705 that had, 149 of 176. Without
the last two, 20 slow oscillations of one to three periods are missed in these."""

EXPLAINED_LEAST = 0.5
"""Least share of the variance about the polynomial that the oscillation explains: the noise of a
well damped loop has no one frequency. From 0.3 to 0.8 the
same trials but four are named."""

GROWTH_ERRORS = 3.0
"""Least growth, in its standard errors: at 5 three of 176 fewer are named, and 6 of 13 instead of
11 where the amplitude grows by a few per cent in a trial."""

SEVERAL, EXPLAINED_OF_FEW = 4.0, 0.98
"""Periods below which an oscillation has to explain that share. Dry friction hunts in unlike
swings: on 1 200 trials of stable reels with Coulomb or Stribeck friction and slow integral gains
one to three of them looked like growth by 3 to 9 errors in 25, and explained 0.53 to 0.973. Where
a loop is unstable so few periods explain 0.985 and more."""

RESOLUTION = 1e-4
"""Least amplitude, as a share of the response: what rounding leaves of a steady state."""

FEWEST = 24
"""Fewest samples of a stretch."""

ITERATIONS = 12

BLOCKS = 8
"""Parts of a stretch whose scatter gives the error where what is left is no white noise."""


def growing_oscillation(values: FloatArray) -> float | None:
    """Frequency, in cycles per sample, of an oscillation that grows; None without one.

    Args:
        values: Response since a change of setpoint or load, shape (samples,).
    """
    size = float(np.ptp(values)) if values.size else 0.0
    if not (math.isfinite(size) and size > 0.0):
        return None
    scaled = (values - values.mean()) / size
    found = (_growing(scaled[scaled.size - round(fit.share * scaled.size) :], fit) for fit in FITS)
    return next((frequency for frequency in found if frequency), None)


def _growing(values: FloatArray, fit: OscillationFit) -> float | None:
    n = values.size
    if n < FEWEST:
        return None
    t, trend, window = _stretch(n, fit.degree)
    y = values - trend @ (trend.T @ values)
    early, late = float(np.sum(y[: n // 2] ** 2)), float(np.sum(y[n - n // 2 :] ** 2))
    if not (late > early and late > RESOLUTION**2 * n):
        return None
    spectrum = np.abs(np.fft.rfft(y * window, 4 * n))
    first = math.ceil(4 * fit.least)
    turns = (first + int(np.argmax(spectrum[first:]))) / 4.0
    x = np.array([0.0, 2.0 * math.pi * turns])  # growth and phase over the stretch
    left, slopes = _residual(x, t, y, trend)
    for _ in range(ITERATIONS):
        step = np.linalg.lstsq(slopes, left, rcond=None)[0]
        step /= max(float(np.abs(step).max()), 1.0)
        moved, further = _residual(x + step, t, y, trend)
        if not moved @ moved < left @ left:
            break
        x, left, slopes = x + step, moved, further
    explained = 1.0 - float(left @ left) / float(y @ y)
    turns = float(x[1]) / (2.0 * math.pi)
    least = EXPLAINED_LEAST if turns >= SEVERAL else EXPLAINED_OF_FEW
    grows = explained > least and x[0] > GROWTH_ERRORS * _growth_error(left, slopes)
    return turns / (n - 1) if grows and fit.least <= turns <= fit.most else None


@lru_cache(maxsize=16)
def _stretch(n: int, degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times from -1/2 to 1/2, an orthonormal basis of the polynomials, and Hann's window.

    They are the same for all trials of a length.
    """
    t = np.linspace(-0.5, 0.5, n)
    return t, np.linalg.qr(np.vander(t, degree + 1))[0], np.hanning(n)


def _growth_error(left: FloatArray, slopes: FloatArray) -> float:
    """Standard error of the growth: the wider of white noise's and the scatter of blocks'."""
    inverse = np.linalg.pinv(slopes.T @ slopes)
    white = float(left @ left) / left.size * inverse[0, 0]
    parts = np.array_split(np.arange(left.size), BLOCKS)
    scores = np.array([slopes[part].T @ left[part] for part in parts])
    clustered = float(np.sum((scores @ inverse[0]) ** 2))
    return math.sqrt(max(white, clustered))


def _residual(
    x: FloatArray, t: FloatArray, y: FloatArray, trend: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the best oscillation of a growth and phase leaves, and the slopes along both."""
    envelope = np.exp(x[0] * t)
    swing = np.stack([envelope * np.cos(x[1] * t), envelope * np.sin(x[1] * t)], axis=1)
    basis = np.linalg.qr(np.concatenate([trend, swing], axis=1))[0]
    own = swing - trend @ (trend.T @ swing)
    a, b = np.linalg.lstsq(own, y, rcond=None)[0]
    grown = t * (a * swing[:, 0] + b * swing[:, 1])
    turned = t * (b * swing[:, 0] - a * swing[:, 1])
    slopes = np.stack([grown, turned], axis=1)
    return y - basis @ (basis.T @ y), slopes - basis @ (basis.T @ slopes)
