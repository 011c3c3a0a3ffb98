"""Number of periods of a residual in a turn, whatever its phase.

A wave over the angle is fitted by least squares beside a straight line for each of many periods
(Zechmeister & Kürster 2009, with the angle for the time), all at once by Fourier transforms of
sums over equal steps of the angle. Records whose angle counts from one zero have one wave in
common; where each began to count anew, each has one of its own, and what they explain is added.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray


class ResidualOverAngle(NamedTuple):
    """A residual over angles that count from one zero; both of shape (samples,), rad."""

    angle_rad: FloatArray
    residual: FloatArray


def per_turn(
    turnings: Sequence[ResidualOverAngle], read_rad: float, fewest: float = 1.0
) -> list[float]:
    """Up to three numbers of periods in a turn that explain the most, the best first.

    Args:
        turnings: Residuals, each with a wave of its own phase.
        read_rad: Step in which the angle is read; it shows no period below two of them.
        fewest: Fewest periods in all the turning there is.
    """
    extent = max((float(np.ptp(t.angle_rad)) for t in turnings), default=0.0)
    if extent <= 2.0 * read_rad:
        return []
    step = max(read_rad, extent / 8192)
    # Eight periods are tried for each that the widest turning tells apart.
    size = 2 ** math.ceil(math.log2(8 * extent / step))
    orders = 2.0 * math.pi / (size * step) * np.arange(size // 2)
    explained = np.sum([_explained(t, step, size) for t in turnings], axis=0)
    inner = np.flatnonzero(orders * extent >= 2.0 * math.pi * fewest)
    inner = inner[inner < orders.size - 1]
    top = (explained[inner] > explained[inner - 1]) & (explained[inner] > explained[inner + 1])
    peaks = inner[top]
    best = peaks[np.argsort(-explained[peaks])][:3]
    return [float(orders[n]) for n in best]


def _explained(turning: ResidualOverAngle, step: float, size: int) -> FloatArray:
    """Share of a detrended residual that a wave explains, shape (size/2,).

    Args:
        step: Step of the angle that samples are summed over, rad.
        size: Length of the transforms; the nth of them is of n periods in `size` steps.
    """
    place = np.rint((turning.angle_rad - turning.angle_rad.min()) / step).astype(np.int64)
    samples = np.bincount(place).astype(np.float64)
    line = np.stack([np.ones(samples.size), np.arange(samples.size) - place.mean()])
    line /= np.sqrt(np.maximum((line**2) @ samples, 1.0))[:, None]
    residual = turning.residual - (line @ np.bincount(place, turning.residual)) @ line[:, place]
    waves = slice(0, size // 2)
    # Sums of a column times exp(-i N angle), over the samples.
    whole = np.fft.fft(samples, size)
    along = np.fft.fft(samples * line, size)[:, waves]
    pull = np.fft.fft(np.bincount(place, residual), size)[waves]
    twice = whole[::2]
    columns = np.stack([along.real, -along.imag])  # cosine and sine with the line
    normal = 0.5 * np.array(
        [[place.size + twice.real, -twice.imag], [-twice.imag, place.size - twice.real]]
    )
    normal -= np.einsum("akn,bkn->abn", columns, columns)
    # Regularised: over a short range of angles a wave resembles a straight line.
    normal[[0, 1], [0, 1]] += 1e-3 * place.size
    weights = np.linalg.solve(
        normal.transpose(2, 0, 1), np.stack([pull.real, -pull.imag], axis=1)[:, :, None]
    )[:, :, 0]
    explained: FloatArray = weights[:, 0] * pull.real - weights[:, 1] * pull.imag
    return explained
