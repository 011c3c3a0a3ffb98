"""What the cost may look like between trials, early in a search: a Gaussian process.

With x the logarithms of the parameters from the start on, l the logarithm of the cost over that of
the first trials has the prior mean and covariance

    m(x)     = x'C x/2
    k(x, y) = s_0^2 + x'S S'y + (x'M M'y)^2 + s_f^2 exp(-|B'(x - y)|^2/2)

a level, a slope, a bowl, and what is none of these but changes over a distance; a trial adds noise
of its own. What is expected of a point and how surely follow by Bayes' rule (Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, chapter 2). C, S, M, B and s_f are `experience` with
other loops. Numbers fitted to the dozen trials of the loop itself made the search slower.
"""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.loop_prior import CostPrior

LEVEL = 2.0  # s_0


class GaussianProcess(NamedTuple):
    """The posterior, given some trials.

    Attributes:
        points: Where the trials were, shape (trials, n).
        precision: Inverse of their covariance, shape (trials, trials).
        weights: Precision times what the mean leaves, one column a quantity.
        variance: Variance of the noise of one trial.
        known: What was known before them.
    """

    points: FloatArray
    precision: FloatArray
    weights: FloatArray
    variance: float
    known: CostPrior

    def expected(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means, shape (points, quantities), and their standard deviation, shape (points,)."""
        k = covariance(self.known, points, self.points)
        left = _variance(self.known, points) - np.sum((k @ self.precision) * k, axis=1)
        mean = k @ self.weights
        mean[:, 0] += expected_before(self.known, points)
        return mean, np.sqrt(np.maximum(left, 0.0))

    def smoothed(self, values: FloatArray) -> FloatArray:
        """Mean of the logarithm of the cost where the trials were, shape (trials,)."""
        mean: FloatArray = values[:, 0] - self.variance * self.weights[:, 0]
        return mean


def fit_gaussian_process(
    points: FloatArray, values: FloatArray, noise: float, known: CostPrior
) -> GaussianProcess:
    """The posterior after trials at these points.

    Args:
        points: Shape (trials, n).
        values: What was observed, the logarithm of the cost first, shape (trials, quantities).
        noise: Standard deviation of it.
        known: What is known before the first trial.
    """
    k = covariance(known, points, points)
    k[np.diag_indices(len(points))] += noise**2
    precision = np.asarray(np.linalg.inv(k), dtype=np.float64)
    left = values.copy()
    left[:, 0] -= expected_before(known, points)
    return GaussianProcess(points, precision, precision @ left, noise**2, known)


def expected_before(known: CostPrior, points: FloatArray) -> FloatArray:
    """The prior mean m, shape (points,)."""
    mean: FloatArray = 0.5 * np.sum((points @ known.bend) * points, axis=1)
    return mean


def covariance(known: CostPrior, left: FloatArray, right: FloatArray) -> FloatArray:
    """The prior covariance k of points with others, shape (left points, right points)."""
    slopes = (left @ known.slope) @ (right @ known.slope).T
    bowls = (left @ known.bowl) @ (right @ known.bowl).T
    a, b = left @ known.rest, right @ known.rest
    squares = np.sum(a * a, axis=1)[:, np.newaxis] + np.sum(b * b, axis=1)
    rest: FloatArray = known.rest_size**2 * np.exp(a @ b.T - 0.5 * squares)
    return LEVEL**2 + slopes + bowls * bowls + rest


def _variance(known: CostPrior, points: FloatArray) -> FloatArray:
    """The diagonal of the covariance of points with themselves."""
    slopes: FloatArray = np.sum((points @ known.slope) ** 2, axis=1)
    bowls: FloatArray = np.sum((points @ known.bowl) ** 2, axis=1)
    return LEVEL**2 + slopes + bowls * bowls + known.rest_size**2
