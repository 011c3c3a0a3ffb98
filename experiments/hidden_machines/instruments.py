"""Noise of gauges, and disturbing forces, as coloured noise."""

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]


def gauge_noise(rng: np.random.Generator, samples: int, rms: float) -> Column:
    """Noise of the gauge: four fifths of its power white, the rest with a memory of 20 samples."""
    slow = _remembering(rng, samples, 0.95)
    white = rng.standard_normal(samples)
    both: Column = rms * (np.sqrt(0.8) * white + np.sqrt(0.2) * slow)
    return both


def disturbance(rng: np.random.Generator, samples: int, rms: float, rate: float) -> Column:
    """A force that wanders over a tenth of a second or so."""
    return rms * _remembering(rng, samples, float(np.exp(-10.0 / rate)))


def _remembering(rng: np.random.Generator, samples: int, kept: float) -> Column:
    """Of variance one; each value keeps a share of the last."""
    fresh = rng.standard_normal(samples) * np.sqrt(1.0 - kept**2)
    out = np.empty(samples)
    value = rng.standard_normal()
    for n, new in enumerate(fresh):
        value = kept * value + new
        out[n] = value
    return out
