"""Discrete filters as triangular systems: SciPy's signal processing takes 0.4 s to load."""

from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray


def lfilter(
    numerator: Sequence[float] | FloatArray,
    denominator: Sequence[float] | FloatArray,
    samples: FloatArray,
) -> FloatArray:
    """Output of a filter that begins at rest, as of `scipy.signal.lfilter`.

    Args:
        numerator: Coefficients of z^0, z^-1, ...
        denominator: The same; the first is not zero.
        samples: Input, filtered along its last axis, shape (..., samples).
    """
    from scipy.linalg.lapack import dtbtrs  # noqa: PLC0415  slow to import

    rows = samples.reshape(-1, samples.shape[-1])
    driven = numerator[0] * rows
    for delay, coefficient in enumerate(numerator[1:], 1):
        driven[:, delay:] += coefficient * rows[:, :-delay]
    if len(denominator) == 1:
        return np.asarray(driven.reshape(samples.shape) / denominator[0])
    # a_0 y_k = driven_k - a_1 y_k-1 - ...: a lower triangular band of equal diagonals. Bytes are
    # repeated three times as fast as numbers, and a diagonal of ones saves half of the solution.
    taps = np.asarray(denominator, float)
    band = np.frombuffer(taps.tobytes() * rows.shape[1]).reshape(-1, taps.size)
    diag = "U" if taps[0] == 1.0 else "N"
    output, _ = dtbtrs(band.T, driven.T, uplo="L", diag=diag, overwrite_b=True)
    return np.asarray(output.T.reshape(samples.shape))
