"""Robust weighted regression of points with different standard errors.

A tuned gain has its tuning's own standard error s_i, which the tuner estimates, and a variation
between tunings of standard deviation tau, which all share and which is unknown. So

    y_i = x_i . beta + e_i,    var e_i = s_i^2 + tau^2

and tau makes the residuals consistent: sum min(u_i^2, k^2) = (n - p) E_k with
u_i = r_i / sqrt(s_i^2 + tau^2). Without the bound k this is the estimate of Paule & Mandel (1982);
with it, Huber's proposal 2 (1964), which is robust to outliers. Where the residuals are smaller
than the s_i predict, tau is zero and all s_i are reduced by one factor, as in any regression with
weights known up to scale. beta is the bisquare estimate (Beaton & Tukey 1974) from a Huber start,
its covariance Huber's (1981, 7.6.7).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

BISQUARE = 6.0
HUBER = 1.345
"""Residuals, in standard deviations, at which the bisquare weight is zero and Huber's below one.
The usual 4.685 rejects good points of small samples so often that intervals are too narrow."""

BOUND = 1.5
"""k: clip of a residual in the estimate of tau, in standard deviations."""

_HUBER_ROUNDS, _BISQUARE_ROUNDS, _BISECTIONS = 5, 15, 30
_SETTLED = 1e-6
_CONDITION_MAX = 1e7
"""Condition of the columns from which length and tension varied together, so that any split of a
gain between them fits alike."""
_FLOOR = 1e-9
"""Least standard deviation of a point, relative to the largest response: rounding error."""


@dataclass(frozen=True, slots=True, eq=False)
class WeightedFit:
    """A fit of p coefficients to n points.

    Attributes:
        coefficients: Shape (p,).
        covariance: Shape (p, p).
        between_sd: tau, in the response's unit.
        residuals: Measured minus fitted, shape (n,).
        deviations: sqrt(s_i^2 + tau^2), or the reduced s_i, same shape.
        robustness: Bisquare weight of each point, 0 to 1, same shape.
        leverage: Diagonal of the hat matrix, same shape.
    """

    coefficients: FloatArray
    covariance: FloatArray
    between_sd: float
    residuals: FloatArray
    deviations: FloatArray
    robustness: FloatArray
    leverage: FloatArray

    @property
    def degrees(self) -> int:
        """Degrees of freedom, n - p."""
        return len(self.residuals) - len(self.coefficients)

    @property
    def weights(self) -> FloatArray:
        """Weight of each squared residual, in one over the response's unit squared."""
        return np.asarray(self.robustness / self.deviations**2)

    @property
    def studentised(self) -> FloatArray:
        """Residuals divided by their own standard deviations."""
        own = self.deviations * np.sqrt(np.maximum(1.0 - self.leverage, 1e-6))
        return np.asarray(self.residuals / own)


def fit_weighted(design: FloatArray, response: FloatArray, own_errors: FloatArray) -> WeightedFit:
    """Fits `response = design @ coefficients`.

    Args:
        design: Shape (n, p).
        response: Shape (n,).
        own_errors: Known standard error s_i of each point, shape (n,).

    Raises:
        InvalidInput: there are no more points than coefficients, or these are not identifiable.
    """
    n, p = design.shape
    if n <= p:
        raise InvalidInput(f"{n} tunings are too few for {p} coefficients; tune {p + 1} or more")
    scale = np.linalg.norm(design, axis=0)
    scaled = design / np.where(scale > 0.0, scale, 1.0)
    if not np.linalg.cond(scaled) < _CONDITION_MAX:
        raise InvalidInput(
            f"the tunings do not identify {p} coefficients; vary length and tension separately"
        )
    # A gain that was held constant has zero residuals and errors: only rounding remains.
    floor = _FLOOR * (float(np.abs(response).max()) or 1.0)
    own = np.hypot(own_errors, floor)
    robust, deviations, tau = np.ones(n), own, 0.0
    for turn in range(_HUBER_ROUNDS + _BISQUARE_ROUNDS):
        beta, leverage = _solve(scaled, response, robust / deviations**2)
        residuals = response - scaled @ beta
        deviations, tau = _deviations(residuals, own, floor, n - p)
        # Leverage hides an outlier from its own residual.
        u = residuals / deviations / np.sqrt(np.maximum(1.0 - leverage, 0.1))
        before, robust = robust, _huber(u) if turn < _HUBER_ROUNDS else _bisquare(u)
        if turn > _HUBER_ROUNDS and np.abs(robust - before).max() < _SETTLED:
            break
    beta, leverage = _solve(scaled, response, robust / deviations**2)
    residuals = response - scaled @ beta
    whole = scaled / deviations[:, None]
    covariance = _inflation(residuals / deviations, p) * np.linalg.inv(whole.T @ whole)
    return WeightedFit(
        coefficients=beta / scale,
        covariance=covariance / np.outer(scale, scale),
        between_sd=tau,
        residuals=residuals,
        deviations=deviations,
        robustness=robust,
        leverage=leverage,
    )


def _solve(
    design: FloatArray, response: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares: coefficients and leverages."""
    root = np.sqrt(weights)
    Q, R = np.linalg.qr(design * root[:, None])
    return np.linalg.solve(R, Q.T @ (response * root)), np.sum(Q * Q, axis=1)


def _deviations(
    residuals: FloatArray, own: FloatArray, floor: float, degrees: int
) -> tuple[FloatArray, float]:
    """The standard deviations consistent with the residuals, and tau."""
    squares, expected = residuals**2, degrees * _EXPECTED

    def bounded(variance: FloatArray) -> float:
        return float(np.minimum(squares / variance, BOUND**2).sum())

    if bounded(own**2) > expected:
        most = float(np.abs(residuals).max()) * math.sqrt(len(residuals))
        tau = _bisect(expected, lambda tau: bounded(own**2 + tau**2), most)
        return np.hypot(own, tau), tau
    factor = _bisect(expected, lambda f: bounded((f * own) ** 2 + floor**2), 1.0)
    return np.hypot(factor * own, floor), 0.0


def _bisect(value: float, function: Callable[[float], float], high: float) -> float:
    """Argument from 0 to `high` at which a decreasing function has a value."""
    low = 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) > value else (low, middle)
    return high


def _huber(u: FloatArray) -> FloatArray:
    return np.asarray(HUBER / np.maximum(np.abs(u), HUBER))


def _bisquare(u: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(1.0 - (u / BISQUARE) ** 2, 0.0) ** 2)


def _inflation(u: FloatArray, p: int) -> float:
    """Huber's factor on the covariance of weighted least squares."""
    n, v = len(u), (u / BISQUARE) ** 2
    psi = u * _bisquare(u)
    slope = np.where(v < 1.0, (1.0 - v) * (1.0 - 5.0 * v), 0.0)
    mean = max(float(slope.mean()), 0.1)
    correction = 1.0 + p / n * float(slope.var()) / mean**2
    return correction**2 * float(psi @ psi) / (n - p) / mean**2


def _expected_bounded_square(k: float) -> float:
    """E min(Z^2, k^2) of a standard normal Z."""
    beyond = math.erfc(k / math.sqrt(2.0))
    density = math.exp(-0.5 * k * k) / math.sqrt(2.0 * math.pi)
    return 1.0 - beyond - 2.0 * k * density + k * k * beyond


_EXPECTED = _expected_bounded_square(BOUND)
