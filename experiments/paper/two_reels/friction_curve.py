"""Loss of tension at an eyelet as a function of the tension."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from experiments.paper.identify.estimate import (
    SIGNIFICANCE_LEVEL,
    Estimate,
    mean_estimate,
    two_sided_p_value,
)


class FrictionCurve(NamedTuple):
    """Loss of tension per eyelet against tension, `F_R = c + a T + b T^2`: B = 1 - a - b T.

    Coulomb's law has b = 0. The constant c is not friction: it absorbs a zero error of X's gauge,
    and a cable that is not quite at the sliding limit.
    """

    constant_N: Estimate  # c, N
    linear: Estimate  # a
    quadratic: Estimate  # b, 1/N
    constant_p_value: float  # p-value of the hypothesis c = 0
    quadratic_p_value: float  # p-value of the hypothesis b = 0

    @property
    def follows_coulomb(self) -> bool:
        """Whether the deviation from Coulomb's law is not significant."""
        return self.quadratic_p_value >= SIGNIFICANCE_LEVEL

    def ratio(self, tension_N: FloatArray) -> FloatArray:
        """B at tensions inside the reel, N."""
        return np.asarray(1.0 - self.linear.value - self.quadratic.value * tension_N)


def fit_loss_curve(tension_N: FloatArray, loss_N: FloatArray) -> FloatArray:
    """Least-squares estimates of c, a and b in `F_R = c + a T + b T^2`."""
    scale = tension_N.max()
    t = tension_N / scale
    solution, *_ = np.linalg.lstsq(np.stack([t**0, t, t**2], axis=1), loss_N, rcond=None)
    return np.asarray(solution / np.array([1.0, scale, scale**2]))


def mean_curve(fits: FloatArray, probability: float) -> FrictionCurve:
    """Mean curve of all sweeps."""
    c, a, b = (
        mean_estimate(column, probability, unit)
        for column, unit in zip(fits.T, ("N", "", "1/N"), strict=True)
    )
    p_values = (two_sided_p_value(e.value, e.standard_error, len(fits) - 1) for e in (c, b))
    return FrictionCurve(c, a, b, *p_values)


def curve_warnings(curve: FrictionCurve, middle_N: float) -> list[str]:
    """Warnings about the shape of the curve."""
    warnings = []
    if not curve.follows_coulomb:
        warnings.append(
            f"friction does not follow Coulomb's law: B changes by {-curve.quadratic.value:.2g} "
            f"per N, and B and C_R hold at {middle_N:.3g} N; set the setpoints about the tension "
            "that matters"
        )
    if curve.constant_p_value < SIGNIFICANCE_LEVEL:
        warnings.append(
            f"the loss of tension has a part of {curve.constant_N.value:.2g} N that does not grow "
            "with tension and was excluded: check the zero of X's gauge, and hold by breakout"
        )
    return warnings
