"""Linear least squares that says how far it can be trusted."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

_CONDITION_MAX = 1e7
"""Of the design with columns of equal length: coefficients keep half of the digits."""


@dataclass(frozen=True, slots=True)
class LackOfFit:
    """Whether the curve misses the means of repeated points by more than their scatter explains.

    Attributes:
        F: Mean square of the curve's misses per mean square of the scatter.
        p_value: Chance of an F so large for a curve of the right form. Below 0.05, say, the form
            is wrong: take a higher order, or look for hysteresis or drift.
        pure_error: Standard deviation of the repeats about their means, in the response's unit.
        degrees: Degrees of freedom of the misses and of the scatter.
    """

    F: float
    p_value: float
    pure_error: float
    degrees: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Regression:
    """A least-squares fit of p coefficients to n points, in plain numbers.

    Attributes:
        coefficients: Best estimates, p of them.
        covariance: Their covariance, p rows of p.
        residuals: Measured minus fitted response, in the order of the points.
        leverage: How much each point draws the curve to itself, zero to one; their sum is p.
        standard_error: Standard deviation of the residuals, from n - p degrees of freedom.
        degrees_of_freedom: n - p, one or more.
        condition: Condition number of the design with columns of equal length.
        lack_of_fit: The test, where there are repeated points that differ; None where there are
            none, where all agree exactly, or where there are no more distinct points than p.

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
                "calibrate anew"
            )

    @property
    def influential(self) -> tuple[int, ...]:
        """Indices of points with a leverage above twice the mean: the fit hangs on them."""
        limit = 2.0 * len(self.coefficients) / len(self.leverage)
        return tuple(i for i, h in enumerate(self.leverage) if h > limit)

    @property
    def studentised(self) -> tuple[float, ...]:
        """Residuals per their own standard deviation; beyond 3 a point deserves a second look."""
        own = self.standard_error * np.sqrt(np.maximum(1.0 - np.asarray(self.leverage), 0.0))
        residuals = np.asarray(self.residuals)
        # A curve drawn through a point by full leverage says nothing of that point.
        return tuple(np.divide(residuals, own, out=np.zeros_like(own), where=own > 0.0).tolist())

    def half_width(
        self, rows: FloatArray, level: float = 0.95, *, repeats: int | None = None
    ) -> FloatArray:
        """Half the width of the confidence band about a linear function of the coefficients.

        Args:
            rows: The function's gradient at each point, shape (..., p).
            level: Confidence, between zero and one.
            repeats: None for the fitted curve itself; a number for the mean of so many new
                measurements.

        Raises:
            InvalidInput: the level or the number of repeats is out of its range.
        """
        if not 0.0 < level < 1.0:
            raise InvalidInput(f"confidence level is {level}; it must lie between 0 and 1")
        if repeats is not None and repeats < 1:
            raise InvalidInput(f"repeats is {repeats}; it must be 1 or more")
        from scipy.special import stdtrit  # noqa: PLC0415  slow to load

        variance = np.einsum("...i,ij,...j", rows, np.asarray(self.covariance), rows)
        new = 0.0 if repeats is None else self.standard_error**2 / repeats
        t = float(stdtrit(self.degrees_of_freedom, 0.5 + 0.5 * level))
        return np.asarray(t * np.sqrt(np.maximum(variance, 0.0) + new))

    @classmethod
    def exact(cls, coefficients: Iterable[float]) -> Self:
        """Coefficients taken as known, as from a data sheet: no points, no uncertainty."""
        known = tuple(map(float, coefficients))
        return cls(
            coefficients=known,
            covariance=((0.0,) * len(known),) * len(known),
            residuals=(),
            leverage=(),
            standard_error=0.0,
            degrees_of_freedom=1,
            condition=1.0,
            lack_of_fit=None,
        )

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Self:
        """The fit that `dataclasses.asdict` and JSON made of one.

        Raises:
            InvalidInput: something is missing or is not of its kind.
        """
        try:
            test = stored["lack_of_fit"]
            return cls(
                coefficients=tuple(map(float, stored["coefficients"])),
                covariance=tuple(tuple(map(float, row)) for row in stored["covariance"]),
                residuals=tuple(map(float, stored["residuals"])),
                leverage=tuple(map(float, stored["leverage"])),
                standard_error=float(stored["standard_error"]),
                degrees_of_freedom=int(stored["degrees_of_freedom"]),
                condition=float(stored["condition"]),
                lack_of_fit=None
                if test is None
                else LackOfFit(**test | {"degrees": tuple(test["degrees"])}),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInput(
                f"stored calibration is damaged: {error!r}; calibrate anew"
            ) from None


def regress(design: FloatArray, response: FloatArray, settings: FloatArray) -> Regression:
    """Fits `response = design @ coefficients` by least squares.

    Args:
        design: Shape (n, p).
        response: Shape (n,), finite.
        settings: What was set at each point, shape (n, k): points with equal rows are repeats.

    Raises:
        InvalidInput: too few points, or points that do not tell the coefficients apart.
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
            f"the points do not tell the {p} coefficients apart (condition number {condition:.2g} "
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
    """Square sum of repeats about their means, degrees of freedom, and distinct settings."""
    _, group = np.unique(settings, axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    mean = np.bincount(group, weights=response) / count
    return float(np.sum((response - mean[group]) ** 2)), response.size - count.size, count.size


def _lack_of_fit(
    response: FloatArray, settings: FloatArray, square_sum: float, p: int
) -> LackOfFit | None:
    scatter, repeats, distinct = pure_error(response, settings)
    misses = distinct - p
    if repeats < 1 or misses < 1 or scatter <= 0.0:
        return None
    from scipy.special import fdtrc  # noqa: PLC0415  slow to load

    F = max(square_sum - scatter, 0.0) / misses / (scatter / repeats)
    return LackOfFit(
        F=F,
        p_value=float(fdtrc(misses, repeats, F)),
        pure_error=float(np.sqrt(scatter / repeats)),
        degrees=(misses, repeats),
    )


def damaged(error: Exception) -> InvalidInput:
    """What to say of a stored calibration that cannot be read."""
    return InvalidInput(f"stored calibration is damaged: {error!r}; calibrate anew")
