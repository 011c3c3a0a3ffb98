"""Dither frequencies that can be told apart, and their curvature too."""

import math
from functools import lru_cache
from typing import NamedTuple


class Dither(NamedTuple):
    """One frequency for each parameter.

    Attributes:
        period: Trials after which all dithers begin anew.
        bins: Turns of each dither in a period.
    """

    period: int
    bins: tuple[int, ...]

    @property
    def frequencies(self) -> tuple[float, ...]:
        """One for each parameter, rad/trial."""
        return tuple([2.0 * math.pi * m / self.period for m in self.bins])


@lru_cache(maxsize=32)
def dither(parameters: int) -> Dither:
    """Frequencies all of whose first- and second-order lines are distinct, by search.

    A quadratic cost answers a dither at w_i with its gradient there, and with its curvature at
    2 w_i and w_i +- w_j. With w_i = 2 pi m_i/N all of these are lines from 0 to N/2, also after
    aliasing. Odd multiples m_i = 3, 5, 7 ... of N = 4 (n + 1) keep gradient and curvature as far
    apart as can be, for sums and differences of odd numbers are even; and 1 is left out, as it
    would pick up the slow fall of the cost itself. But lines of the curvature then fall on one
    another. Found is the least refinement of that grid on which they do not once the multiples are
    shifted by less than a third of its old spacing.
    """
    fineness = 1
    while not (bins := _distinct(parameters, fineness, (), frozenset())):
        fineness += 1
    return Dither(4 * (parameters + 1) * fineness, bins)


def _distinct(
    parameters: int, fineness: int, bins: tuple[int, ...], taken: frozenset[int]
) -> tuple[int, ...]:
    """The bins completed so that no line is taken twice; empty where that cannot be."""
    if len(bins) == parameters:
        return bins
    period, nominal = 4 * (parameters + 1) * fineness, (2 * len(bins) + 3) * fineness
    for shift in range(-(fineness // 3), fineness // 3 + 1):
        m = nominal + shift
        answers = (m, 2 * m, *[m + sign * other for other in bins for sign in (1, -1)])
        lines = {min(line % period, -line % period) for line in answers}
        if len(lines) == len(answers) and 0 not in lines and not lines & taken:
            found = _distinct(parameters, fineness, (*bins, m), taken | lines)
            if found:
                return found
    return ()
