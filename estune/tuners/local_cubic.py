"""Local cubic model of the cost, late in a search: regularised regression about a centre.

With z = x - c the logarithms of the parameters from the centre on, and l that of the cost,

    l(z) = l_0 + g.z + z'Hz/2 + sum c_ijk u_i u_j u_k + d a + error

is fitted to all trials by Bayesian least squares (Bishop, Pattern Recognition and Machine
Learning, 2006, section 3.3), each coefficient with a normal prior. The cubic terms keep asymmetry
about the centre from passing for a slope. They are taken along the axes of H, u_i = h_i^(1/3) z_i,
so that a direction with little curvature gets little cubic term. The last term allows for drift,
with a the age of a trial. Far trials weigh less, because a cubic cannot follow the cost there: the
error of a trial has the variance

    v = sigma^2 + (p q^2)^2,    q = z'Hz/2

where q is the expected rise of the cost by the previous H, or the observed rise, reduced, if that
is more: beyond the edge of stability the cost rises as no polynomial does. A residual of more than
three standard deviations counts as three (Huber), so that one bad trial does not move the fit.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray

MODEL_ERROR = 0.5  # p, error per square of the rise
OBSERVED_SHARE = 0.7  # share of the observed rise that counts as expected
LEVEL_SD = 3.0  # prior standard deviation of l_0
SLOPE_SD = 1.0  # of g
CURVATURE_SD = 1.0  # of h_ii, relative to its mean
CROSS_SD = 0.4  # of h_ij, relative to the root of both means
CUBIC_SD = 0.4  # of c_ijk
DRIFT_SD = 0.05  # of d, per hundred trials
NOISE_EXPECTED = 0.03  # sigma before there are residuals
NOISE_WEIGHT = 3.0  # number of trials that this expectation counts for
CURVATURE_MIN = 0.02  # a step by less curvature could be of any length
OUTLIER_SDS = 3.0  # residuals beyond count no more

IndexArray = NDArray[np.intp]


class LocalCubicModel(NamedTuple):
    """The posterior, given some trials.

    Attributes:
        centre: c, shape (n,).
        cubic_axes: Takes z to u, shape (n, n).
        coefficients: Of 1, z_i, z_i z_j, u_i u_j u_k and a; one column a quantity.
        covariance: Of the coefficients, the same for every quantity.
        noise: Standard deviation sigma of one trial.
        curvatures: Eigenvalues of H, at least CURVATURE_MIN, shape (n,).
        axes: Its eigenvectors, one a column.
    """

    centre: FloatArray
    cubic_axes: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    noise: float
    curvatures: FloatArray
    axes: FloatArray

    @property
    def log_cost(self) -> float:
        """l_0 at the centre."""
        return float(self.coefficients[0, 0])

    @property
    def slope(self) -> FloatArray:
        """g, shape (n,)."""
        return self.coefficients[1 : 1 + len(self.centre), 0]

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means, shape (points, quantities), and their standard deviation, shape (points,)."""
        terms = _terms(points - self.centre, self.cubic_axes, np.zeros(len(points)))
        variance = np.sum((terms @ self.covariance) * terms, axis=1)
        return terms @ self.coefficients, np.sqrt(np.maximum(variance, 0.0))


def curvature_matrix(squares: FloatArray, n: int) -> FloatArray:
    """H by its coefficients of z_i z_j, shape (..., n, n) of (..., n (n+1)/2)."""
    upper = np.zeros((*squares.shape[:-1], n, n))
    a, b = _pairs(n)
    upper[..., a, b] = squares
    return upper + np.swapaxes(upper, -1, -2)


def fit_local_cubic(
    centre: FloatArray,
    curvature: FloatArray,
    points: FloatArray,
    values: FloatArray,
    *,
    noise: float,
    prior_curvature: FloatArray,
) -> LocalCubicModel:
    """The posterior about a centre.

    Args:
        centre: c, shape (n,).
        curvature: H of the previous fit, shape (n, n).
        points: The trials, the oldest first, shape (trials, n).
        values: Observations, the log cost first, shape (trials, quantities).
        noise: sigma of the previous fit.
        prior_curvature: Prior mean of H, shape (n, n).
    """
    z = points - centre
    weights = _weights(z, curvature, values[:, 0], noise)
    stiffness, axes = np.linalg.eigh(curvature)
    cubic_axes = axes * np.cbrt(np.maximum(stiffness, CURVATURE_MIN))
    age = np.arange(len(z) - 1.0, -1.0, -1.0) / 100.0
    terms, (means, precisions) = _terms(z, cubic_axes, age), _prior(prior_curvature)
    prior_term = np.zeros((terms.shape[1], values.shape[1]))
    prior_term[:, 0] = means * precisions

    def solve(weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        weighted = terms.T * weights
        information = weighted @ terms
        covariance = np.asarray(np.linalg.inv(information + np.diag(precisions)), dtype=np.float64)
        return covariance @ (weighted @ values + prior_term), covariance, information

    coefficients, covariance, information = solve(weights)
    deviations = np.abs(values[:, 0] - terms @ coefficients[:, 0]) * np.sqrt(weights)
    if deviations.max() > OUTLIER_SDS:
        weights *= OUTLIER_SDS / np.maximum(deviations, OUTLIER_SDS)
        coefficients, covariance, information = solve(weights)
    residuals = values[:, 0] - terms @ coefficients[:, 0]
    shares = weights * noise**2  # one for a near trial, towards zero for a far one
    freedom = max(float(shares.sum() - np.sum(covariance * information)), 1.0)
    power = NOISE_WEIGHT * NOISE_EXPECTED**2 + float(np.sum(shares * residuals**2))
    sigma = math.sqrt(power / (NOISE_WEIGHT + freedom))
    n = len(centre)
    squares = coefficients[1 + n : 1 + n + n * (n + 1) // 2, 0]
    curvatures, axes = np.linalg.eigh(curvature_matrix(squares, n))
    curvatures = np.maximum(curvatures, CURVATURE_MIN)
    return LocalCubicModel(centre, cubic_axes, coefficients, covariance, sigma, curvatures, axes)


def newton_step(
    slope: FloatArray, curvatures: FloatArray, axes: FloatArray, radius: float
) -> FloatArray:
    """The step to the minimum of a quadratic, at most a radius long (Levenberg & Marquardt).

    Args:
        slope: g, shape (n,).
        curvatures: Along the axes, above zero, shape (n,).
        axes: One a column, orthonormal, shape (n, n).
        radius: Longest step.
    """
    along = axes.T @ slope

    def step(damping: float) -> FloatArray:
        damped: FloatArray = along / (curvatures + damping)
        return damped

    damping = 0.0
    if math.hypot(*step(0.0)) > radius:
        low, damping = 0.0, math.hypot(*along) / radius  # the step shortens as damping grows
        for _ in range(30):
            middle = 0.5 * (low + damping)
            if math.hypot(*step(middle)) > radius:
                low = middle
            else:
                damping = middle
    taken: FloatArray = -axes @ step(damping)
    return taken


def _weights(
    z: FloatArray, curvature: FloatArray, log_costs: FloatArray, noise: float
) -> FloatArray:
    """1/v of every trial."""
    rise = 0.5 * np.sum((z @ curvature) * z, axis=1)
    lowest = np.sort(log_costs)[: z.shape[1] + 1].mean()
    rise = np.maximum(rise, OBSERVED_SHARE * (log_costs - lowest))
    weights: FloatArray = 1.0 / (noise**2 + (MODEL_ERROR * rise**2) ** 2)
    return weights


@lru_cache(maxsize=16)
def _pairs(n: int) -> tuple[IndexArray, IndexArray]:
    return np.triu_indices(n)


@lru_cache(maxsize=16)
def _triples(n: int) -> tuple[IndexArray, IndexArray, IndexArray]:
    triples = [(i, j, k) for i in range(n) for j in range(i, n) for k in range(j, n)]
    i, j, k = np.array(triples, dtype=np.intp).T
    return i, j, k


def _terms(z: FloatArray, cubic_axes: FloatArray, age: FloatArray) -> FloatArray:
    """1, z_i, z_i z_j and u_i u_j u_k with i <= j <= k, and the age, one row a point."""
    n, u = z.shape[1], z @ cubic_axes
    (a, b), (i, j, k) = _pairs(n), _triples(n)
    terms = np.empty((len(z), 2 + n + len(a) + len(i)))
    terms[:, 0] = 1.0
    terms[:, 1 : 1 + n] = z
    terms[:, 1 + n : 1 + n + len(a)] = z[:, a] * z[:, b]
    terms[:, 1 + n + len(a) : -1] = u[:, i] * u[:, j] * u[:, k]
    terms[:, -1] = age
    return terms


def _prior(curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and precision of every coefficient, by the prior mean of H."""
    n = len(curvature)
    (a, b), cubes = _pairs(n), len(_triples(n)[0])
    share = np.where(a == b, 0.5, 1.0)  # the coefficient of z_i^2 is half of h_ii
    size = np.sqrt(curvature[a, a] * curvature[b, b])
    squares = share * np.where(a == b, CURVATURE_SD, CROSS_SD) * size
    means = np.concatenate((np.zeros(1 + n), share * curvature[a, b], np.zeros(cubes + 1)))
    sds = np.concatenate(([LEVEL_SD], [SLOPE_SD] * n, squares, [CUBIC_SD] * cubes, [DRIFT_SD]))
    return means, sds**-2.0
