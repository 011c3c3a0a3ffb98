"""Comparison of the friction of the two reels of a bench."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.estimate import (
    SIGNIFICANCE_LEVEL,
    Estimate,
    student_quantile,
    two_sided_p_value,
)
from experiments.paper.two_reels.evaluation import TwoReelResult
from experiments.paper.two_reels.friction_ratio import attenuation

_CONDITION_MAX = 1e3
"""Maximum condition number; measurements with similar bends amplify their errors."""


class ReelComparison(NamedTuple):
    """Friction coefficients of two reels, and a test of their equality."""

    coefficient_x: Estimate  # friction coefficient C_R of X alone
    coefficient_y: Estimate  # friction coefficient C_R of Y alone
    p_value: float  # p-value of the hypothesis that the reels have the same coefficient

    @property
    def alike(self) -> bool:
        """Whether the coefficients do not differ significantly."""
        return self.p_value >= SIGNIFICANCE_LEVEL


def compare_reels(first: TwoReelResult, second: TwoReelResult) -> ReelComparison:
    """Friction coefficient of each reel, from two measurements with different angles.

    One measurement determines only `B_X B_Y`, as the cable passes both eyelets in series. With the
    angles exchanged, equal reels give the same product, unequal ones do not: two losses
    `-ln B_X - ln B_Y` determine two coefficients, by Newton's method. Nothing else may change
    between the measurements.

    Raises:
        InvalidInput: the angles do not separate the reels, or no two coefficients explain both
            measurements.
    """
    runs = first, second
    loss_measured = np.array([-2.0 * np.log(run.attenuation.value) for run in runs])
    C = np.full(2, np.mean([run.friction_coefficient.value for run in runs]))
    for _ in range(50):
        losses, slopes = _losses(C, runs)
        if np.linalg.cond(slopes) > _CONDITION_MAX:
            raise InvalidInput(
                "the two measurements bend the cable alike at both reels and do not separate "
                "them; exchange the angles of X and Y, with a sharper bend at one of them"
            )
        inverse = np.linalg.inv(slopes)
        change = inverse @ (loss_measured - losses)
        C = C + change
        if not ((C > 0.0) & (C < 1.0)).all():
            break
        if (np.abs(change) <= 1e-10 * C).all():
            return _comparison(C, np.asarray(inverse, dtype=np.float64), runs)
    raise InvalidInput(
        "no friction coefficients between 0 and 1 explain both measurements; check the angles, "
        "and that nothing else was changed in between"
    )


def _losses(C: FloatArray, runs: tuple[TwoReelResult, ...]) -> tuple[FloatArray, FloatArray]:
    """`-ln B_X - ln B_Y` of each measurement, shape (2,), and slopes in C_X, C_Y, shape (2, 2)."""

    def loss(coefficient: float, angles_rad: tuple[float, ...]) -> float:
        return -float(np.log(attenuation(coefficient, *angles_rad)))

    h = 1e-6 * C
    parts = np.empty((3, 2, 2))
    for n, run in enumerate(runs):
        for side, angles in enumerate((run.angles_x_rad, run.angles_y_rad)):
            for k, shift in enumerate((0.0, -h[side], h[side])):
                parts[k, n, side] = loss(float(C[side] + shift), angles)
    return parts[0].sum(axis=1), (parts[2] - parts[1]) / (2.0 * h)


def _comparison(
    C: FloatArray, inverse: FloatArray, runs: tuple[TwoReelResult, ...]
) -> ReelComparison:
    error = np.array([2.0 * r.attenuation.standard_error / r.attenuation.value for r in runs])
    freedom = sum(run.ratios.shape[0] - 1 for run in runs)
    width = student_quantile(runs[0].probability, freedom)
    x, y = (
        Estimate.normal(float(c), float(e), width)
        for c, e in zip(C, np.hypot(*(inverse * error).T), strict=True)
    )
    apart = float(np.hypot(*((inverse[0] - inverse[1]) * error)))
    return ReelComparison(x, y, two_sided_p_value(x.value - y.value, apart, freedom))
