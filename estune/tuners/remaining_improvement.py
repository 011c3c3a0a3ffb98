"""The optimum and the remaining improvement, as far as the local cubic model leaves them open."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.acquisition import TrustRegion
from estune.tuners.local_cubic import CURVATURE_MIN, LocalCubicModel, curvature_matrix
from estune.tuners.low_discrepancy import normal_points

SAMPLES = 256
"""Number of posterior samples; 2.5 % of them are six."""


class QuadraticSamples(NamedTuple):
    """Posterior samples of the cost as quadratics.

    Attributes:
        minima: Minimum of each within the region, shape (samples, n).
        improvement: Log cost at the centre above that at the minimum, shape (samples,).
    """

    minima: FloatArray
    improvement: FloatArray

    def intervals(self, region: TrustRegion) -> FloatArray:
        """95 % intervals of the optimum, shape (2, n); to the bounds where the region ends."""
        low, high = np.quantile(self.minima, (0.025, 0.975), axis=0)
        low = np.where(low < region.centre - 0.8 * region.radius, region.low, low)
        high = np.where(high > region.centre + 0.8 * region.radius, region.high, high)
        return np.stack((low, high))


def expected_improvement(model: LocalCubicModel, region: TrustRegion) -> float:
    """Expected remaining improvement, -g.s - s'Hs/2 plus the part of an uncertain g on each axis.

    s is Newton's step as far as the bounds allow. A slope with standard deviation d adds d^2/(2 h)
    on average, but no more than it can reduce the cost within the region.
    """
    slopes = slice(1, 1 + len(model.centre))
    axes, curvatures = model.axes, model.curvatures
    newton = axes @ ((axes.T @ model.slope) / curvatures)
    step = region.clip(model.centre - newton) - model.centre
    certain = -model.slope @ step - 0.5 * np.sum(curvatures * (axes.T @ step) ** 2)
    variance = np.sum((model.covariance[slopes, slopes] @ axes) * axes, axis=0)
    uncertain = np.minimum(0.5 * variance / curvatures, np.sqrt(variance) * region.radius)
    return float(max(certain, 0.0) + np.sum(uncertain))


def sample_quadratics(model: LocalCubicModel, region: TrustRegion) -> QuadraticSamples:
    """Quadratics with slope and curvature from the posterior, and their minima.

    The cubic terms matter little this near; the uncertainty they add is in the posterior already.
    """
    n = len(model.centre)
    kept = slice(1, 1 + n + n * (n + 1) // 2)
    root = np.linalg.cholesky(model.covariance[kept, kept])
    samples = model.coefficients[kept, 0] + normal_points(len(root), SAMPLES) @ root.T
    slope = samples[:, :n]
    values, axes = np.linalg.eigh(curvature_matrix(samples[:, n:], n))
    along = np.einsum("dij,di->dj", axes, slope)
    # Along a direction without curvature the optimum lies at the edge of the region; the
    # improvement on the way there follows from the least curvature that a step is taken by.
    positive = np.maximum(values, CURVATURE_MIN)
    far = np.where(values < CURVATURE_MIN, np.copysign(region.radius, along), along / positive)
    minima = region.project(model.centre - np.einsum("dij,dj->di", axes, far))
    newton = np.einsum("dij,dj->di", axes, along / positive)
    step = region.project(model.centre - newton) - model.centre
    rise = 0.5 * np.sum(positive * np.einsum("dij,di->dj", axes, step) ** 2, axis=1)
    improvement: FloatArray = -np.sum(slope * step, axis=1) - rise
    return QuadraticSamples(minima, np.maximum(improvement, 0.0))
