"""Filters of the prediction error of a loop model; see `least_squares`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.compiled_errors import NoiseFilters
from estune.loop_model.noise_model import NoiseModel, shaping
from estune.loop_model.poles import sections_of


class Filters(NamedTuple):
    """Filters of the prediction error: e = (1/H) y - (numerator of the effort / free) B u.

    Attributes:
        effort: Numerator of the effort's filter: P N, one with white noise.
        free: Its denominator in sections, whose free responses the error has: C, or A mirrored.
        zeros: Of H, in sections; with white noise those of poles outside the unit circle.
        poles: Of H, in sections; the same.
    """

    effort: FloatArray
    free: tuple[FloatArray, ...]
    zeros: tuple[FloatArray, ...]
    poles: tuple[FloatArray, ...]


def filters_of(
    coordinates: Sequence[float] | FloatArray, noise: NoiseModel, settling: float
) -> Filters:
    """The filters of the prediction error at some poles and noise."""
    if noise.is_white:
        sections = sections_of(coordinates)
        growing = [section for section in sections if section.grows]
        return Filters(
            np.ones(1),
            tuple(section.mirrored for section in sections),
            tuple(section.mirrored for section in growing),
            tuple(section.taps for section in growing),
        )
    H = shaping(coordinates, noise, settling)
    return Filters(H.effort, H.zeros, H.zeros, H.poles)


def noise_filters(
    coordinates: Sequence[float] | FloatArray, noise: NoiseModel, settling: float
) -> NoiseFilters:
    """The filters of a noise that is not white, as compiled code takes them."""
    H = shaping(coordinates, noise, settling)
    zeros, over = len(coordinates) // 2 + 1, len(H.poles) - 1
    taps = np.zeros((zeros + over, 3))
    taps[:, 0] = 1.0
    for row, section in zip(
        (*range(len(H.zeros)), *range(zeros, zeros + over)), (*H.zeros, *H.poles[:-1]), strict=True
    ):
        taps[row, : section.size] = section
    return NoiseFilters(zeros, over, np.concatenate([taps.ravel(), H.effort]))


def regressors_of(signals: FloatArray, filters: Filters, poles: int) -> FloatArray:
    """Regressors of a polynomial, undelayed, shape (poles + 1, records, samples)."""
    driven = lfilter(filters.effort, [1.0], signals)
    terms = [whiten(driven, filters.free, ())]
    for _ in range(poles):
        terms.append(differenced(terms[-1], 1.0))
    return np.stack(terms)


def differenced(signals: FloatArray, share: float) -> FloatArray:
    """Signals less a share of the sample before."""
    result = signals.copy()
    result[..., 1:] -= share * signals[..., :-1]
    return result


def whiten(
    signals: FloatArray, zeros: Sequence[FloatArray], poles: Sequence[FloatArray]
) -> FloatArray:
    """Signals through 1/H, section by section."""
    for i in range(max(len(zeros), len(poles))):
        over = poles[i] if i < len(poles) else np.ones(1)
        under = zeros[i] if i < len(zeros) else np.ones(1)
        signals = lfilter(over, under, signals)
    return signals


def delayed(signals: FloatArray, samples: int) -> FloatArray:
    """Signals so many samples later, zero before, shape (..., samples)."""
    later = np.zeros_like(signals)
    later[..., samples:] = signals[..., : max(signals.shape[-1] - samples, 0)]
    return later


def without(signals: FloatArray, basis: FloatArray) -> FloatArray:
    """Signals less their part in an orthonormal basis, shape (..., samples)."""
    return np.asarray(signals - (signals @ basis) @ basis.T)
