"""Gaussian process of the cost early in a search, with a prior from simulated PIDF loops.

With x the logarithms of the parameters from the start on, l the logarithm of the cost over that of
the first trials has the prior mean and covariance

    m(x)    = x'C x/2
    k(x, y) = s_0^2 + x'S S'y + (x'M M'y)^2 + s_f^2 exp(-|B'(x - y)|^2/2)

of a level, a slope, a quadratic, and a remainder that changes over a distance. Each trial adds
noise. The posterior follows by Bayes' rule (Rasmussen & Williams, Gaussian Processes for Machine
Learning, 2006, chapter 2). Hyperparameters fitted to the dozen trials of the loop itself made the
search slower, so that C, S, M, B and s_f are a prior, `PIDF_LOOP_PRIOR`.

In logarithms of the gains relative to the optimum, the costs of PIDF loops are alike, whatever the
plant and its speed. They curve most along P, less along I and D, least along the setpoint filter's
time constant. P and D may grow together, and P with the time constant, at little cost. The numbers
were fitted to searches on 350 simulated loops drawn at random: plants of first to fifth order,
lightly and well damped, with and without dead time and a limit of the effort, each with a cost of
its own. `experiments.loop_prior` draws others, fits the numbers again and measures what they are
worth.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.search_space import Directions

LEVEL_SD = 2.0
"""s_0, prior standard deviation of the level."""

PRIOR_INFLATION = 1.4
"""A rig differs more from the simulated loops than they do from one another: factor on the prior
standard deviation of slopes and remainder."""


class CostPrior(NamedTuple):
    """Prior of the log cost over n logarithms from the start on.

    Attributes:
        slope: S, shape (n, 4 m) for m loops; the slopes have the covariance S S'.
        quadratic: M, same shape; the quadratic terms have the covariance (x'M M'y)^2.
        inverse_length: B, same shape; the remainder has the covariance exp(-|B'(x - y)|^2/2).
        remainder_sd: s_f, standard deviation of the remainder.
        mean_rise: C, shape (n, n); the prior mean is x'C x/2.
        curvature: H, shape (n, n); mean curvature about an optimum, for `local_cubic`.
    """

    slope: FloatArray
    quadratic: FloatArray
    inverse_length: FloatArray
    remainder_sd: float
    mean_rise: FloatArray
    curvature: FloatArray


PIDF_LOOP_PRIOR = CostPrior(
    slope=PRIOR_INFLATION
    * np.array(
        [
            [0.305, 0.0, 0.0, 0.0],
            [0.160, 0.357, 0.0, 0.0],
            [-0.028, -0.069, 0.147, 0.0],
            [-0.057, -0.028, -0.023, 0.0],
        ]
    ),
    quadratic=np.array(
        [
            [0.089, 0.0, 0.0, 0.0],
            [-0.149, 0.230, 0.0, 0.0],
            [0.019, -0.187, 0.0, 0.0],
            [-0.005, 0.005, 0.0, 0.0],
        ]
    ),
    inverse_length=np.array(
        [
            [2.048, 0.0, 0.0, 0.0],
            [-0.147, 2.133, 0.0, 0.0],
            [0.137, -0.932, 1.361, 0.0],
            [-0.207, -0.126, 0.029, 0.406],
        ]
    ),
    remainder_sd=PRIOR_INFLATION * 0.267,
    mean_rise=np.array(
        [
            [0.108, -0.029, -0.005, -0.011],
            [-0.029, 0.222, -0.095, 0.016],
            [-0.005, -0.095, 0.044, -0.004],
            [-0.011, 0.016, -0.004, 0.004],
        ]
    ),
    curvature=np.array(
        [
            [1.40, -0.06, -0.25, -0.26],
            [-0.06, 0.95, -0.30, -0.03],
            [-0.25, -0.30, 0.65, 0.015],
            [-0.26, -0.03, 0.015, 0.15],
        ]
    ),
)
"""In the logarithms of P, I, D and the setpoint filter's time constant."""


@lru_cache(maxsize=64)
def cost_prior(directions: Directions) -> CostPrior:
    """Prior of the cost of a loop whose parameters have these directions.

    A parameter is a direction in the four logarithms of the gains, see `SearchSpace.directions`.
    So the prior holds for either form of the gains, and for fewer parameters.
    """
    table = np.array(directions)
    return CostPrior(
        slope=table @ PIDF_LOOP_PRIOR.slope,
        quadratic=table @ PIDF_LOOP_PRIOR.quadratic,
        inverse_length=table @ PIDF_LOOP_PRIOR.inverse_length,
        remainder_sd=PIDF_LOOP_PRIOR.remainder_sd,
        mean_rise=table @ PIDF_LOOP_PRIOR.mean_rise @ table.T,
        curvature=table @ PIDF_LOOP_PRIOR.curvature @ table.T,
    )


class GaussianProcess(NamedTuple):
    """The posterior, given some trials.

    Attributes:
        points: Shape (trials, n).
        log_costs: Observed, shape (trials,).
        precision: Inverse of the covariance of the trials, shape (trials, trials).
        weights: Precision times the deviations from the prior mean, one column a quantity.
    """

    points: FloatArray
    log_costs: FloatArray
    precision: FloatArray
    weights: FloatArray
    noise_variance: float
    prior: CostPrior

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means, shape (points, quantities), and their standard deviation, shape (points,)."""
        k = prior_covariance(self.prior, points, self.points)
        variance = _prior_variance(self.prior, points) - np.sum((k @ self.precision) * k, axis=1)
        mean = k @ self.weights
        mean[:, 0] += prior_mean(self.prior, points)
        return mean, np.sqrt(np.maximum(variance, 0.0))

    def smoothed(self) -> FloatArray:
        """Mean of the log cost at the trials, shape (trials,)."""
        mean: FloatArray = self.log_costs - self.noise_variance * self.weights[:, 0]
        return mean


def fit_gaussian_process(
    points: FloatArray, values: FloatArray, noise: float, prior: CostPrior
) -> GaussianProcess:
    """The posterior after trials at these points.

    Args:
        points: Shape (trials, n).
        values: Observations, the log cost first, shape (trials, quantities).
        noise: Standard deviation of an observation.
    """
    k = prior_covariance(prior, points, points)
    k[np.diag_indices(len(points))] += noise**2
    precision = np.asarray(np.linalg.inv(k), dtype=np.float64)
    deviations = values.copy()
    deviations[:, 0] -= prior_mean(prior, points)
    weights = precision @ deviations
    return GaussianProcess(points, values[:, 0], precision, weights, noise**2, prior)


NOISES = 0.03 * 2.0 ** np.arange(-1.5, 2.0, 0.5)
"""Standard deviations of one trial's log cost among which the likeliest is taken: 1 to 8.5 %."""


def likeliest_noise(points: FloatArray, values: FloatArray, prior: CostPrior) -> float:
    """The noise of `NOISES` with the greatest marginal likelihood (Rasmussen & Williams, 5.4.1).

    In 96 searches at 10 % noise it halved the unsafe trials, and searches of 3 % noise ended
    after 78 trials instead of 82.

    Args:
        points: Shape (trials, n).
        values: Observations, the log cost first, shape (trials, quantities).
    """
    k = prior_covariance(prior, points, points)
    deviations = values[:, 0] - prior_mean(prior, points)
    sizes, vectors = np.linalg.eigh(k)
    along = vectors.T @ deviations
    variances = np.maximum(sizes, 0.0) + NOISES[:, np.newaxis] ** 2
    minus_log = np.sum(along**2 / variances + np.log(variances), axis=1)
    return float(NOISES[int(np.argmin(minus_log))])


def prior_mean(prior: CostPrior, points: FloatArray) -> FloatArray:
    """Prior mean m, shape (points,)."""
    mean: FloatArray = 0.5 * np.sum((points @ prior.mean_rise) * points, axis=1)
    return mean


def prior_covariance(prior: CostPrior, left: FloatArray, right: FloatArray) -> FloatArray:
    """Prior covariance k, shape (left points, right points)."""
    slopes = (left @ prior.slope) @ (right @ prior.slope).T
    quadratics = (left @ prior.quadratic) @ (right @ prior.quadratic).T
    a, b = left @ prior.inverse_length, right @ prior.inverse_length
    squares = np.sum(a * a, axis=1)[:, np.newaxis] + np.sum(b * b, axis=1)
    remainder: FloatArray = prior.remainder_sd**2 * np.exp(a @ b.T - 0.5 * squares)
    return LEVEL_SD**2 + slopes + quadratics * quadratics + remainder


def _prior_variance(prior: CostPrior, points: FloatArray) -> FloatArray:
    """The diagonal of the covariance of points with themselves."""
    slopes: FloatArray = np.sum((points @ prior.slope) ** 2, axis=1)
    quadratics: FloatArray = np.sum((points @ prior.quadratic) ** 2, axis=1)
    return LEVEL_SD**2 + slopes + quadratics * quadratics + prior.remainder_sd**2
