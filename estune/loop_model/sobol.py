"""Points of the Sobol sequence: `scipy.stats`, which has them, takes a second to load."""

from functools import lru_cache

import numpy as np

from estune.core.quantities import FloatArray

BITS = 30

_RECURRENCES = ((0, 0, (1,)), (1, 0, (1,)), (2, 1, (1, 3)), (3, 1, (1, 3, 1)))
"""Degree and inner coefficients of the primitive polynomial of each dimension, and the first
direction numbers (Joe and Kuo, SIAM Journal on Scientific Computing 30, 2008)."""


@lru_cache(maxsize=16)
def sobol_points(dimensions: int, count: int) -> FloatArray:
    """The first points of the sequence in the unit cube, read-only, shape (count, dimensions)."""
    directions = np.array([_directions(dimension) for dimension in range(dimensions)])
    bits, points = np.zeros(dimensions, dtype=np.int64), np.zeros((count, dimensions))
    for number in range(1, count):
        lowest_zero = (~(number - 1) & number).bit_length() - 1
        bits ^= directions[:, lowest_zero]
        points[number] = bits / 2.0**BITS
    points.flags.writeable = False
    return points


def _directions(dimension: int) -> list[int]:
    """Direction numbers of a dimension, as multiples of 2^-BITS."""
    degree, inner, first = _RECURRENCES[dimension]
    m = list(first)
    while len(m) < BITS:
        if not degree:
            m.append(1)
            continue
        following = m[-degree] ^ (m[-degree] << degree)
        for i in range(1, degree):
            if inner >> (degree - 1 - i) & 1:
                following ^= m[-i] << i
        m.append(following)
    return [number << (BITS - 1 - i) for i, number in enumerate(m)]
