"""Where to look next: the least of a bound within reach of the centre, among what looks safe."""

import math
from typing import NamedTuple, Protocol

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.low_discrepancy import unit_ball_points

LOOKS = 128
"""Points looked at in the first round, over the whole reach; half as many in each later one."""

ROUNDS = 3
NARROWING = 3.0
"""Each round looks about the best of the one before, this many times narrower."""

DOUBT = 2.5
"""Standard deviations by which a point must look safe."""

POOL = 16 * LOOKS
"""Points in store, so that consecutive trials look at different ones."""


class Model(Protocol):
    """What can say what to expect of a point."""

    def expected(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean of every quantity, shape (points, quantities), and standard deviation, (points,).

        The first quantity is the logarithm of the cost, the second the margin, if there is one.
        """
        ...


class TrustRegion(NamedTuple):
    """How far a trial may lie from the centre, and what makes it look safe.

    Attributes:
        centre: Shape (n,).
        axes: Half axes of an ellipsoid about it, one a column, orthogonal, shape (n, n).
        radius: Greatest distance from the centre.
        low: Lower bounds, shape (n,).
        high: Upper bounds.
        log_cost_max: Greatest logarithm of the cost that is safe.
        margin: Least margin that is safe.
    """

    centre: FloatArray
    axes: FloatArray
    radius: float
    low: FloatArray
    high: FloatArray
    log_cost_max: float
    margin: float

    def within(self, points: FloatArray) -> FloatArray:
        """The points, those outside drawn in towards the centre, and within the bounds."""
        away = points - self.centre
        inside = (away @ self.axes) / np.sum(self.axes * self.axes, axis=0)
        far = np.maximum(_length(inside), _length(away) / self.radius)
        drawn: FloatArray = self.centre + away / np.maximum(far, 1.0)[:, np.newaxis]
        return self.bounded(drawn)

    def bounded(self, points: FloatArray) -> FloatArray:
        """The nearest points within the bounds."""
        return np.clip(points, self.low, self.high)

    def constraint_violation(self, mean: FloatArray, spread: FloatArray) -> FloatArray:
        """By how much points pass what is safe, in doubt; zero where they do not."""
        over = np.maximum(mean[:, 0] + DOUBT * spread - self.log_cost_max, 0.0)
        if mean.shape[1] > 1:
            over += np.maximum(self.margin - (mean[:, 1] - DOUBT * spread), 0.0)
        return over

    def is_inside(self, point: FloatArray) -> bool:
        """Whether a point, shape (n,), is at none of the bounds."""
        return bool(np.all((self.low < point) & (point < self.high)))

    def is_safe(self, model: Model, point: FloatArray) -> bool:
        """Whether a point, shape (n,), looks safe."""
        return not self.constraint_violation(*model.expected(point[np.newaxis]))[0]


def minimise_confidence_bound(
    model: Model, reach: TrustRegion, first: FloatArray, curiosity: float, turn: int
) -> FloatArray:
    """The point whose mean less `curiosity` standard deviations is least, or the safest.

    Args:
        model: What is expected.
        reach: Where to look.
        first: Points to be looked at too, shape (points, n).
        curiosity: Standard deviations.
        turn: Number of the trial, which decides what else is looked at.
    """
    n = len(reach.centre)
    pool = unit_ball_points(n, POOL)
    offset = turn * LOOKS % POOL
    best, width = first, 1.0
    for turns in range(ROUNDS):
        size = LOOKS if turns == 0 else LOOKS // 2
        looks = best[:1] + width * pool[offset : offset + size] @ reach.axes.T
        points = reach.within(np.concatenate((best, looks)))
        mean, spread = model.expected(points)
        over = reach.constraint_violation(mean, spread)
        # Whatever is safe comes before whatever is not.
        rank = np.where(over > 0.0, 1e6 + over, mean[:, 0] - curiosity * spread)
        chosen = int(np.argmin(rank))
        best, width = points[chosen : chosen + 1], width / NARROWING
    point: FloatArray = best[0]
    return point


def newton_step(
    slope: FloatArray, values: FloatArray, axes: FloatArray, radius: float
) -> FloatArray:
    """The step to the least of a bowl, no longer than a radius (Levenberg & Marquardt).

    Args:
        slope: g, shape (n,).
        values: Curvatures along the axes, above zero, shape (n,).
        axes: One a column, orthonormal, shape (n, n).
        radius: Longest step.
    """
    along = axes.T @ slope

    def step(damping: float) -> FloatArray:
        found: FloatArray = along / (values + damping)
        return found

    damping = 0.0
    if math.hypot(*step(0.0)) > radius:
        low, damping = 0.0, math.hypot(*along) / radius  # the step shortens as damping grows
        for _ in range(30):
            middle = 0.5 * (low + damping)
            low, damping = (
                (middle, damping) if math.hypot(*step(middle)) > radius else (low, middle)
            )
    taken: FloatArray = -axes @ step(damping)
    return taken


def _length(rows: FloatArray) -> FloatArray:
    length: FloatArray = np.sqrt(np.sum(rows * rows, axis=1))
    return length
