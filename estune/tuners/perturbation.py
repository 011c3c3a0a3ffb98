"""Dither of the parameters and the filters of its response, one trial a step.

The washout filter (z - 1)/(z + h) removes the slowly changing part of the cost. The low-pass
l/(1 - (1 - l)/z) removes harmonics of the dither and noise from the demodulated signal.
"""

import cmath
import math
from functools import lru_cache
from typing import NamedTuple


class Dither(NamedTuple):
    """One frequency for each parameter, rad/trial: whole turns in a period, counted in trials."""

    period: int
    frequencies: tuple[float, ...]


@lru_cache(maxsize=32)
def dither(parameters: int) -> Dither:
    """Frequencies whose first- and second-order lines are all distinct.

    A quadratic cost responds to a dither at w_i with its gradient there, and with its curvature at
    2 w_i and w_i +- w_j. With w_i = 2 pi m_i/N these are lines from 0 to N/2, also after aliasing.
    Odd multiples m_i = 3, 5, 7 ... of N = 4 (n + 1) keep gradient and curvature as far apart as
    possible, because sums and differences of odd numbers are even. The multiple 1 would pick up
    the slow decrease of the cost itself. On that grid lines of the curvature coincide. The result
    is its least refinement on which they do not, with multiples shifted by less than a third of
    the old spacing.
    """
    refinement = 1
    while not (bins := _distinct_bins(parameters, refinement, (), frozenset())):
        refinement += 1
    period = 4 * (parameters + 1) * refinement
    return Dither(period, tuple([2.0 * math.pi * m / period for m in bins]))


def _distinct_bins(
    parameters: int, refinement: int, bins: tuple[int, ...], taken: frozenset[int]
) -> tuple[int, ...]:
    """The bins completed so that no line is taken twice; empty where that is impossible."""
    if len(bins) == parameters:
        return bins
    period, nominal = 4 * (parameters + 1) * refinement, (2 * len(bins) + 3) * refinement
    for shift in range(-(refinement // 3), refinement // 3 + 1):
        m = nominal + shift
        multiples = (m, 2 * m, *[m + sign * other for other in bins for sign in (1, -1)])
        lines = {min(line % period, -line % period) for line in multiples}
        if len(lines) == len(multiples) and 0 not in lines and not lines & taken:
            completed = _distinct_bins(parameters, refinement, (*bins, m), taken | lines)
            if completed:
                return completed
    return ()


def washout_at_rest(h: float, level: float) -> float:
    """The washout's state zeta after a long time at one level, where its output is zero."""
    return level / (1.0 + h)


def washout(h: float, zeta: float, level: float) -> tuple[float, float]:
    """Output at k and state zeta(k+1) of (z - 1)/(z + h), as Killingsworth & Krstic (2006).

        zeta(k) = -h zeta(k-1) + J(k-1),    output(k) = J(k) - (1 + h) zeta(k)

    Args:
        h: The pole lies at -h, 0 < h < 1.
        zeta: State zeta(k).
        level: Input J(k).
    """
    return level - (1.0 + h) * zeta, -h * zeta + level


def washout_response(h: float, frequency: float) -> tuple[float, float]:
    """Gain and phase lead in rad of the washout at a frequency in rad/trial."""
    z = cmath.exp(1j * frequency)
    response = (z - 1.0) / (z + h)
    return abs(response), cmath.phase(response)


def low_pass(share: float, level: float, signal: float) -> float:
    """One step of the first-order low-pass with unit gain at rest; `share` weights the signal."""
    return level + share * (signal - level)
