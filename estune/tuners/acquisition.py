"""Minimisation of the lower confidence bound over the safe part of a trust region."""

from typing import NamedTuple, Protocol

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.low_discrepancy import unit_ball_points

POINTS = 128
"""Points evaluated in the first round, over the whole region; half as many in each later one."""

ROUNDS = 3
NARROWING = 3.0
"""Each round searches about the best point of the round before, this many times narrower."""

SAFETY_SDS = 2.5
"""Standard deviations by which a point must satisfy the constraints to count as safe."""

POOL = 16 * POINTS
"""Points in store, so that consecutive trials evaluate different ones."""


class Model(Protocol):
    """A model of the cost, and of the constraint margin where there is a limit."""

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean of every quantity, shape (points, quantities), and standard deviation, (points,).

        The first quantity is the log cost, the second the constraint margin, if there is one.
        """
        ...


class TrustRegion(NamedTuple):
    """The set in which the next trial may lie, and the constraints that make it safe.

    Attributes:
        centre: Shape (n,).
        axes: Half axes of an ellipsoid about it, one a column, orthogonal, shape (n, n).
        radius: Greatest distance from the centre.
        low: Lower bounds, shape (n,).
        high: Upper bounds.
    """

    centre: FloatArray
    axes: FloatArray
    radius: float
    low: FloatArray
    high: FloatArray
    log_cost_max: float
    margin_min: float

    def project(self, points: FloatArray) -> FloatArray:
        """The points, drawn towards the centre into the region, and within the bounds."""
        away = points - self.centre
        scaled = (away @ self.axes) / np.sum(self.axes * self.axes, axis=0)
        excess = np.maximum(_norms(scaled), _norms(away) / self.radius)
        inside: FloatArray = self.centre + away / np.maximum(excess, 1.0)[:, np.newaxis]
        return self.clip(inside)

    def clip(self, points: FloatArray) -> FloatArray:
        """The nearest points within the bounds."""
        return np.clip(points, self.low, self.high)

    def constraint_violation(self, mean: FloatArray, sd: FloatArray) -> FloatArray:
        """Violation of the constraints at their confidence bound; zero at safe points."""
        violation = np.maximum(mean[:, 0] + SAFETY_SDS * sd - self.log_cost_max, 0.0)
        if mean.shape[1] > 1:
            violation += np.maximum(self.margin_min - (mean[:, 1] - SAFETY_SDS * sd), 0.0)
        return violation

    def expected_violation(self, mean: FloatArray, sd: FloatArray) -> FloatArray:
        """Violation as above, but of the constraint margin as expected.

        Where no point is safe, that of the confidence bound is least where the trials were, and
        the search would repeat one of them for ever.
        """
        violation = np.maximum(mean[:, 0] + SAFETY_SDS * sd - self.log_cost_max, 0.0)
        if mean.shape[1] > 1:
            violation += np.maximum(self.margin_min - mean[:, 1], 0.0)
        return violation

    def is_inside_bounds(self, point: FloatArray) -> bool:
        """Whether a point, shape (n,), is at none of the bounds."""
        return bool(np.all((self.low < point) & (point < self.high)))

    def is_safe(self, model: Model, point: FloatArray) -> bool:
        """Whether a point, shape (n,), satisfies the constraints with confidence."""
        return not self.constraint_violation(*model.predict(point[np.newaxis]))[0]


def minimise_confidence_bound(
    model: Model, region: TrustRegion, seeds: FloatArray, exploration_weight: float, trial: int
) -> FloatArray:
    """The point of least lower confidence bound among safe ones, or of least violation.

    Args:
        model: Prediction of cost and margin.
        region: Where to search.
        seeds: Further points to evaluate, shape (points, n).
        exploration_weight: kappa, standard deviations subtracted from the mean.
        trial: Number of the trial; selects the points that are evaluated.
    """
    pool = unit_ball_points(len(region.centre), POOL)
    offset = trial * POINTS % POOL
    best, width = seeds, 1.0
    for number in range(ROUNDS):
        size = POINTS if number == 0 else POINTS // 2
        about = best[:1] + width * pool[offset : offset + size] @ region.axes.T
        points = region.project(np.concatenate((best, about)))
        mean, sd = model.predict(points)
        violation = region.constraint_violation(mean, sd)
        # Every safe point ranks before every unsafe one.
        unsafe = 1e6 + region.expected_violation(mean, sd)
        rank = np.where(violation > 0.0, unsafe, mean[:, 0] - exploration_weight * sd)
        chosen = int(np.argmin(rank))
        best, width = points[chosen : chosen + 1], width / NARROWING
    point: FloatArray = best[0]
    return point


def _norms(rows: FloatArray) -> FloatArray:
    norms: FloatArray = np.sqrt(np.sum(rows * rows, axis=1))
    return norms
