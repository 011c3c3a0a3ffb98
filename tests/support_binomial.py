"""Bounds on counts that agree with a claimed rate."""

from scipy.stats import binom

CHANCE = 0.001
"""Probability that a count violates its bound where the claimed rate is just met."""


def least_hits(n: int, rate: float) -> int:
    """Least count among n that agrees with a rate of at least `rate`."""
    return int(binom.ppf(CHANCE, n, rate))


def most_misses(n: int, rate: float) -> int:
    """Greatest count among n that agrees with a rate of at most `rate`."""
    return int(binom.isf(CHANCE, n, rate))
