"""What each record has of its own beside the model: the state it begins from, and offsets."""

from functools import lru_cache

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import delayed, filters_of, whiten
from estune.loop_model.fit_signals import FitSignals, RecordGroup
from estune.loop_model.noise_model import NoiseModel

NUISANCE_APART = 1e-7
"""Least share of the largest singular value by which start state and offsets differ."""


def free_parameters(group: RecordGroup, poles: int, noise: NoiseModel) -> int:
    """Start states and offsets of the records of a group, with this number of poles.

    Those of a hum are the same for all models of the records.
    """
    return len(group.members) * (_swinging(group, poles, noise) + 2)


def _swinging(group: RecordGroup, poles: int, noise: NoiseModel) -> int:
    """Number of start states that are free, with this number of poles.

    Of a loop at rest no mode swings: free states of each take up noise, and a damping of 0.6 % was
    fitted as zero.
    """
    return 2 if noise.is_white and not group.history else poles


def nuisance_of(
    group: RecordGroup, coordinates: FloatArray, noise: NoiseModel, signals: FitSignals
) -> FloatArray:
    """Orthonormal basis of start states and offsets of a group, shape (samples, up to n + 6)."""
    poles = tuple(coordinates[: _swinging(group, coordinates.size, noise)].tolist())
    columns = _nuisance_columns(
        poles, noise, signals.settling_samples, signals.longest, signals.hum
    )
    matrix = columns[:, : group.length]
    matrix = matrix / np.maximum(np.linalg.norm(matrix, axis=1, keepdims=True), 1e-300)
    # Start state and level span the response to an offset of the effort, but for integrators.
    left, sizes, _ = np.linalg.svd(matrix.T, full_matrices=False)
    return np.asarray(left[:, sizes > NUISANCE_APART * sizes[0]])


@lru_cache(maxsize=4)
def _nuisance_columns(
    coordinates: tuple[float, ...], noise: NoiseModel, settling: float, samples: int, hum: float
) -> FloatArray:
    """Free responses, offsets and hum, shape (up to n + 6, samples); fewer begin alike."""
    pulse, levels = np.eye(1, samples), [np.ones(samples)]
    if hum:
        # With an amplitude that changes along the record: its frequency is not exact.
        at, place = hum * np.arange(samples), np.linspace(-1.0, 1.0, samples)
        levels += [np.cos(at), np.sin(at), place * np.cos(at), place * np.sin(at)]
    filters = filters_of(coordinates, noise, settling)
    offsets = list(whiten(np.array(levels), filters.zeros, filters.poles))
    columns, free = [], pulse
    for taps in filters.free:
        free = lfilter([1.0], taps, free)
        columns += [delayed(free, i)[0] for i in range(taps.size - 1)]
    if noise.is_white:  # with a noise model its forgetting has an offset of the effort die out
        last = columns[-1] if filters.free[-1].size == 2 else columns[-2]
        offsets.append(np.cumsum(last))
    return np.array([*columns, *offsets])
