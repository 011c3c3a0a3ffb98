"""Linear least squares with confidence intervals and a lack-of-fit test."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.support.plain_fault import plain_fault

_CONDITION_MAX = 1e7
"""Of the design with columns of equal length: coefficients keep half of the digits."""


@dataclass(frozen=True, slots=True)
class LackOfFit:
    """Lack-of-fit test: deviation of the curve from the means of repeats, against pure error.

    Attributes:
        F: Mean square of the lack of fit over that of the pure error.
        p_value: Probability of so large an F for the right form of curve. Below 0.05, say, choose
            a higher order, or look for hysteresis or drift.
        pure_error: Standard deviation of the repeats about their means, in the response's unit.
        degrees: Degrees of freedom of the lack of fit and of the pure error.
    """

    F: float
    p_value: float
    pure_error: float
    degrees: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Regression:
    """A least-squares fit of p coefficients to n points, in plain numbers.

    Attributes:
        coefficients: Estimates, p of them.
        covariance: Their covariance, p rows of p.
        residuals: Measured minus fitted response, in the order of the points.
        leverage: Weight of each point in its own fitted value, zero to one; their sum is p.
        standard_error: Standard deviation of the residuals, from n - p degrees of freedom.
        degrees_of_freedom: n - p, one or more.
        condition: Condition number of the design with columns of equal length.
        lack_of_fit: The test; None without repeats that differ, or with no more than p distinct
            points.

    Raises:
        InvalidInput: numbers that are not finite, or a covariance of another size.
    """

    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    residuals: tuple[float, ...]
    leverage: tuple[float, ...]
    standard_error: float
    degrees_of_freedom: int
    condition: float
    lack_of_fit: LackOfFit | None

    def __post_init__(self) -> None:
        p = len(self.coefficients)
        numbers = np.array([*self.coefficients, *sum(self.covariance, ()), self.standard_error])
        if [len(row) for row in self.covariance] != [p] * p or not np.isfinite(numbers).all():
            raise InvalidInput(
                f"a fit of {p} coefficients needs a {p} x {p} covariance and finite numbers; "
                "calibrate again"
            )

    def half_width(self, row: FloatArray) -> float:
        """Half width of the 95 % confidence interval of a linear function of the coefficients.

        Args:
            row: Gradient of the function, shape (p,).
        """
        from scipy.special import stdtrit  # noqa: PLC0415  slow to load

        variance = float(row @ np.asarray(self.covariance) @ row)
        t = float(stdtrit(self.degrees_of_freedom, 0.975))
        return t * math.sqrt(max(variance, 0.0))

    @classmethod
    def exact(cls, coefficients: Iterable[float]) -> Self:
        """Coefficients known exactly, as from a data sheet: no points, no uncertainty."""
        exact = tuple(map(float, coefficients))
        return cls(
            coefficients=exact,
            covariance=((0.0,) * len(exact),) * len(exact),
            residuals=(),
            leverage=(),
            standard_error=0.0,
            degrees_of_freedom=1,
            condition=1.0,
            lack_of_fit=None,
        )


@dataclass(frozen=True, slots=True)
class Stored:
    """Base of the calibrations: their form in JSON."""

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dictionaries, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Self:
        """The calibration of the values that `as_dict` gave.

        Raises:
            InvalidInput: a value is missing, of the wrong type, or the curve is not monotone.
        """
        try:
            return TypeAdapter(cls).validate_python(stored)
        except ValidationError as error:
            faults = error.errors(include_url=False, include_context=False)
            listed = "; ".join(
                f"{'.'.join(map(str, f['loc']))}: {plain_fault(f['msg'])}" for f in faults
            )
            raise InvalidInput(
                f"stored calibration is damaged: {listed}; calibrate again"
            ) from None


def regress(design: FloatArray, response: FloatArray, settings: FloatArray) -> Regression:
    """Fits `response = design @ coefficients` by least squares.

    Args:
        design: Shape (n, p).
        response: Shape (n,), finite.
        settings: Settings of each point, shape (n, k); points with equal rows are repeats.

    Raises:
        InvalidInput: too few points, or a design that does not determine the coefficients.
    """
    n, p = design.shape
    if n <= p:
        raise InvalidInput(
            f"{n} points are too few for {p} coefficients; measure {p + 1} or more, better {3 * p}"
        )
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    singular = np.linalg.svd(design / scale, compute_uv=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    if not condition < _CONDITION_MAX:
        raise InvalidInput(
            f"the points do not determine the {p} coefficients (condition number {condition:.2g} "
            f"over {_CONDITION_MAX:.0g}); vary each setting on its own, or lower the order"
        )
    Q, R = np.linalg.qr(design / scale)
    coefficients = np.linalg.solve(R, Q.T @ response) / scale
    residuals = response - design @ coefficients
    square_sum = float(residuals @ residuals)
    inverse = np.linalg.inv(R) / scale[:, None]
    variance = square_sum / (n - p)
    return Regression(
        coefficients=tuple(coefficients.tolist()),
        covariance=tuple(map(tuple, (variance * inverse @ inverse.T).tolist())),
        residuals=tuple(residuals.tolist()),
        leverage=tuple(np.sum(Q * Q, axis=1).tolist()),
        standard_error=float(np.sqrt(variance)),
        degrees_of_freedom=n - p,
        condition=condition,
        lack_of_fit=_lack_of_fit(response, settings, square_sum, p),
    )


def pure_error(response: FloatArray, settings: FloatArray) -> tuple[float, int, int]:
    """Sum of squares of repeats about their means, degrees of freedom, and distinct settings."""
    _, group = np.unique(settings, axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    mean = np.bincount(group, weights=response) / count
    return float(np.sum((response - mean[group]) ** 2)), response.size - count.size, count.size


def _lack_of_fit(
    response: FloatArray, settings: FloatArray, square_sum: float, p: int
) -> LackOfFit | None:
    error, repeats, distinct = pure_error(response, settings)
    lack = distinct - p
    if repeats < 1 or lack < 1 or error <= 0.0:
        return None
    from scipy.special import fdtrc  # noqa: PLC0415  slow to load

    F = max(square_sum - error, 0.0) / lack / (error / repeats)
    return LackOfFit(
        F=F,
        p_value=float(fdtrc(lack, repeats, F)),
        pure_error=float(np.sqrt(error / repeats)),
        degrees=(lack, repeats),
    )
