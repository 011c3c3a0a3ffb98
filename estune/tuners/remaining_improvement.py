"""Where the optimum may be, and what is left to gain there, by what is not known of the cost."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.acquisition import TrustRegion
from estune.tuners.local_cubic import FLAT, LocalCubicModel, curvature_of
from estune.tuners.low_discrepancy import normal_points

DRAWS = 256
"""Bowls that stand for all that the cost may be; enough for a 2.5 % quantile to be one of six."""


class QuadraticSamples(NamedTuple):
    """Costs that the trials leave possible, each with its own least.

    Attributes:
        least: Where each is least within reach, shape (draws, n).
        gain: By how much the logarithm of the cost at the centre lies above it, shape (draws,).
    """

    least: FloatArray
    gain: FloatArray


def expected_gain(
    model: LocalCubicModel, values: FloatArray, axes: FloatArray, reach: TrustRegion
) -> float:
    """What is expected to be left, -g.s - s'Hs/2 and what the doubt of g adds along each axis.

    Here s is Newton's step as far as the bounds let it go, for beyond them nothing is to be had.
    A slope in doubt by d adds d^2/(2 h) on average, but no more than is gained within reach.

    Args:
        model: The cost.
        values: Curvatures along the axes, above zero, shape (n,).
        axes: One a column, orthonormal, shape (n, n).
        reach: The bounds.
    """
    slopes = slice(1, 1 + len(values))
    newton = axes @ ((axes.T @ model.slope) / values)
    step = reach.bounded(model.centre - newton) - model.centre
    sure = -model.slope @ step - 0.5 * np.sum(values * (axes.T @ step) ** 2)
    spread = np.sum((model.spread[slopes, slopes] @ axes) * axes, axis=0)
    doubt = np.minimum(0.5 * spread / values, np.sqrt(spread) * reach.radius)
    return float(max(sure, 0.0) + np.sum(doubt))


def sample_quadratics(model: LocalCubicModel, reach: TrustRegion) -> QuadraticSamples:
    """Slopes and curvatures drawn from the posterior, and the least of each such bowl.

    The cubic terms matter little this near; what they take from the certainty of the others is in
    the posterior already.
    """
    n = len(model.centre)
    kept = slice(1, 1 + n + n * (n + 1) // 2)
    spread = np.linalg.cholesky(model.spread[kept, kept])
    drawn = model.coefficients[kept, 0] + normal_points(len(spread), DRAWS) @ spread.T
    slope = drawn[:, :n]
    values, axes = np.linalg.eigh(curvature_of(drawn[:, n:], n))
    along = np.einsum("dij,di->dj", axes, slope)
    # Along a direction that does not bend the optimum lies as far away as may be believed; what is
    # to be gained on the way there is told by the least bend that a step is taken by.
    bent = np.maximum(values, FLAT)
    far = np.where(values < FLAT, np.copysign(reach.radius, along), along / bent)
    least = reach.within(model.centre - np.einsum("dij,dj->di", axes, far))
    step = reach.within(model.centre - np.einsum("dij,dj->di", axes, along / bent)) - model.centre
    rise = 0.5 * np.sum(bent * np.einsum("dij,di->dj", axes, step) ** 2, axis=1)
    gain: FloatArray = -np.sum(slope * step, axis=1) - rise
    return QuadraticSamples(least, np.maximum(gain, 0.0))
