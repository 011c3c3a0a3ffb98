"""Dither frequencies that can be told apart."""

import math
from functools import lru_cache


@lru_cache(maxsize=32)
def odd_frequencies(parameters: int) -> tuple[float, ...]:
    """One dither frequency per parameter, in rad/trial: odd multiples of a common base.

    With period N = 4 (n + 1) trials, w_i = 2 pi (2 i + 1)/N for i = 1 ... n. A quadratic cost
    answers at w_i with its gradient, and at 2 w_i and w_i +- w_j with its curvature; the latter
    are even multiples of the base (also after aliasing, as N is even), so they never fall on an
    odd one and the gradient is read clean. The lowest multiple, 1, is left out: it would pick up
    the slow fall of the cost itself. All dithers are orthogonal over one period.
    """
    period = 4 * (parameters + 1)
    return tuple(2.0 * math.pi * (2 * i + 1) / period for i in range(1, parameters + 1))
