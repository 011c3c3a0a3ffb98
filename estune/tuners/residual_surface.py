"""Differences of trials from the predictions of a model, as a surface over the gains.

The differences in log cost and in overshoot are Gaussian processes of zero mean with the kernel
s^2 exp(-|x - x'|^2/2) in logarithms of the gains. Their size s grows with the misfit rho of the
model: where it explains the records, the surface would only add the noise of the costs.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.prediction import Prediction

MISFIT_MIN = 0.002
"""Misfit up to which the model predicts alone. With the surface, searches on plants of the
model's class end 0.5 to 2 % above the optimum, without it 0.0 %."""

COST_PER_MISFIT = 5.0
"""Size of the surface of the log cost per misfit beyond `MISFIT_MIN`: on plants outside the class
the cost of trials up to a logarithm away differs by 1 to 3 times the misfit."""

NOISE_MIN = 1e-3
"""Least standard deviation of the log cost: without any, trials at one place leave no inverse."""

OVERSHOOT_NOISE = 0.01
"""Standard deviation of a measured overshoot, as a share of the step."""


class ResidualSurface(NamedTuple):
    """The surface.

    Attributes:
        points: Coordinates of the trials, shape (trials, n).
        inverse: Of their covariance over s^2, shape (trials, trials).
        differences: In log cost and in overshoot, weighted by `inverse`, shape (trials, 2).
        size: s of the log cost.
    """

    points: FloatArray
    inverse: FloatArray
    differences: FloatArray
    size: float

    @classmethod
    def fitted(
        cls,
        points: Sequence[Sequence[float]],
        differences: Sequence[tuple[float, float]],
        misfit: float,
        noise: float,
    ) -> "ResidualSurface | None":
        """The surface of trials; None where the model predicts alone.

        Args:
            points: Coordinates of the trials.
            differences: Measured log cost and overshoot less the predicted ones.
            misfit: rho of the model.
            noise: Standard deviation of the log cost of a trial.
        """
        size, noise = COST_PER_MISFIT * (misfit - MISFIT_MIN), max(noise, NOISE_MIN)
        known = [i for i, pair in enumerate(differences) if np.isfinite(pair).all()]
        if size <= 0.0 or not known:
            return None
        x = np.array([points[i] for i in known])
        d = np.array([differences[i] for i in known], dtype=float)
        near = _kernel(x, x)
        inverse = np.asarray(np.linalg.inv(near + (noise / size) ** 2 * np.eye(len(known))))
        wide = np.linalg.solve(near + (OVERSHOOT_NOISE / size) ** 2 * np.eye(len(known)), d[:, 1])
        return cls(x, inverse, np.column_stack([inverse @ d[:, 0], wide]), size)

    def corrected(self, x: FloatArray, p: Prediction) -> Prediction:
        """A prediction with the surface at its coordinates, shape (n,), on top."""
        if not math.isfinite(p.cost):
            return p
        log_cost, overshoot = _kernel(x[np.newaxis], self.points)[0] @ self.differences
        return p._replace(
            cost=p.cost * math.exp(log_cost), overshoot=max(p.overshoot + float(overshoot), 0.0)
        )

    def deviation(self, x: FloatArray) -> float:
        """Standard deviation of the log cost that is left at coordinates of shape (n,)."""
        near = _kernel(x[np.newaxis], self.points)[0]
        return self.size * math.sqrt(max(1.0 - float(near @ self.inverse @ near), 0.0))


def _kernel(one: FloatArray, other: FloatArray) -> FloatArray:
    squares = np.sum((one[:, np.newaxis] - other) ** 2, axis=2)
    return np.asarray(np.exp(-0.5 * squares))
