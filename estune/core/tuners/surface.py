"""What the cost may look like between trials, early in a search: a Gaussian process.

With x the logarithms of the parameters from the start on, l the logarithm of the cost over that of
the first trials has the prior mean and covariance

    m(x)     = a |x|^2/2
    k(x, x') = s_0^2 + s_1^2 x.x' + s_2^2 (x.x')^2 + s_f^2 exp(-|x - x'|^2/(2 b^2))

a level, a slope, a bowl, and what is none of these but changes over a distance b; a trial adds
noise of its own. The mean bends upward by a, for no gain may grow for ever. What is expected of a
point and how surely follow by Bayes' rule (Rasmussen & Williams, Gaussian Processes for Machine
Learning, 2006, chapter 2). The six numbers are the same for every rig: they say what logarithms of
costs and gains are like. Numbers fitted to a dozen trials made the search slower.
"""

from typing import NamedTuple

import numpy as np

from estune.core.tuners.spread import FloatArray

CURVATURE = 0.1  # a
LEVEL = 2.0  # s_0
SLOPE = 0.5  # s_1
BOWL = 0.35  # s_2
REST = 0.8  # s_f
REACH = 1.2  # b


class Surface(NamedTuple):
    """The posterior, given some trials.

    Attributes:
        points: Where the trials were, shape (trials, n).
        precision: Inverse of their covariance, shape (trials, trials).
        weights: Precision times what the mean leaves, one column a quantity.
        variance: Variance of the noise of one trial.
    """

    points: FloatArray
    precision: FloatArray
    weights: FloatArray
    variance: float

    def expected(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means, shape (points, quantities), and their standard deviation, shape (points,)."""
        k = _covariance(points, self.points)
        left = _variance(points) - np.sum((k @ self.precision) * k, axis=1)
        mean = k @ self.weights
        mean[:, 0] += _prior_mean(points)
        return mean, np.sqrt(np.maximum(left, 0.0))

    def smoothed(self, values: FloatArray) -> FloatArray:
        """Mean of the logarithm of the cost where the trials were, shape (trials,)."""
        mean: FloatArray = values[:, 0] - self.variance * self.weights[:, 0]
        return mean


def surface(points: FloatArray, values: FloatArray, noise: float) -> Surface:
    """The posterior after trials at these points.

    Args:
        points: Shape (trials, n).
        values: What was observed, the logarithm of the cost first, shape (trials, quantities).
        noise: Standard deviation of it.
    """
    k = _covariance(points, points)
    k[np.diag_indices(len(points))] += noise**2
    precision = np.asarray(np.linalg.inv(k), dtype=np.float64)
    left = values.copy()
    left[:, 0] -= _prior_mean(points)
    return Surface(points, precision, precision @ left, noise**2)


def _prior_mean(points: FloatArray) -> FloatArray:
    mean: FloatArray = 0.5 * CURVATURE * np.sum(points * points, axis=1)
    return mean


def _covariance(left: FloatArray, right: FloatArray) -> FloatArray:
    products: FloatArray = left @ right.T
    squares = np.sum(left * left, axis=1)[:, np.newaxis] + np.sum(right * right, axis=1)
    rest: FloatArray = REST**2 * np.exp((products - 0.5 * squares) / REACH**2)
    return LEVEL**2 + products * (SLOPE**2 + BOWL**2 * products) + rest


def _variance(points: FloatArray) -> FloatArray:
    """The diagonal of the covariance of points with themselves."""
    squares: FloatArray = np.sum(points * points, axis=1)
    return LEVEL**2 + squares * (SLOPE**2 + BOWL**2 * squares) + REST**2
