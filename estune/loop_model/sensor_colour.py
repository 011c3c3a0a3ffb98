"""Colour of a sensor's noise: an autoregression N of what load and drift leave of the errors.

A converter's steps, a mean over several readings or interference that is sampled too slowly make
noise whose samples are not independent. The controller feeds it back, so that a fit which takes it
for white gives the plant poles that are none: a pair without damping at half the sampling rate in
measured records of a heated chamber, and a load in place of its slowest pole.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.least_squares import Solution
from estune.loop_model.noise_model import NoiseModel

LONGEST = 8
"""Most coefficients of N: of eleven records of a heated chamber (10 800 samples) two lower the
criterion by 300, four by 750, six by 860 and eight by 930."""


def recoloured(signals: FitSignals, solution: Solution) -> NoiseModel:
    """The noise of a solution with the colour that its errors have; as it is, without any noise.

    The number of coefficients is the one of the least Bayesian criterion.
    """
    noise = solution.noise
    if noise.is_white:
        return noise
    plain = noise._replace(colour=())
    if noise.colour:
        x, numerator = solution.coordinates, solution.numerator
        solution = Solution.at(signals, x, solution.dead, plain, numerator)
    return plain._replace(colour=_autoregression(signals, solution.residual))


def _autoregression(signals: FitSignals, errors: FloatArray) -> tuple[float, ...]:
    """Coefficients behind the leading one, by the recursion of Levinson and Durbin."""
    moments = np.zeros(LONGEST + 1)
    for row in signals.split(errors):
        for lag in range(min(moments.size, row.shape[1])):
            moments[lag] += float(np.vdot(row[:, lag:], row[:, : row.shape[1] - lag]))
    if not moments[0] > 0.0:  # nothing is left that could have a colour
        return ()
    price, count = math.log(errors.size), errors.size
    N, power = np.ones(1), float(moments[0])
    best, least = N, count * math.log(power)
    for order in range(1, moments.size):
        reflection = -float(N @ moments[order:0:-1]) / power
        N = np.append(N, 0.0)
        N = N + reflection * N[::-1]
        power *= 1.0 - reflection**2
        criterion = count * math.log(power) + order * price
        if criterion < least:
            best, least = N, criterion
    return tuple(best[1:].tolist())
