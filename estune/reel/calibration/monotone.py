"""Monotone calibration curves: range and checks."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, check_not_negative, checked_array
from estune.errors import InvalidInput
from estune.reel.calibration.regression import pure_error

_REVERSAL_LEVEL = 0.999
"""One-sided confidence at which means of repeats count as out of order."""

_FLAT = 1e-9  # slope per largest coefficient; less is rounding


@dataclass(frozen=True, slots=True)
class Axis:
    """A calibrated range of a quantity, scaled to -1..1.

    Attributes:
        margin: Accepted excess beyond either end, as a share of the range.

    Raises:
        InvalidInput: not finite, empty, or a margin below zero.
    """

    name: str
    unit: str
    low: float
    high: float
    margin: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise InvalidInput(
                f"{self.name} is calibrated from {self.low} to {self.high} {self.unit}; a "
                "calibration needs different, finite values"
            )
        check_not_negative(f"margin of {self.name}", self.margin)

    @property
    def reach(self) -> float:
        """Greatest accepted scaled value."""
        return 1.0 + 2.0 * self.margin

    def scaled(self, values: ArrayLike) -> FloatArray:
        """The scaled values.

        Raises:
            InvalidInput: a value is not finite, or outside the range and its margin.
        """
        array = checked_array(self.name, values, self.unit)
        scale = (array - 0.5 * (self.low + self.high)) / (0.5 * (self.high - self.low))
        # Ends computed by way of the inverse may lie outside by rounding.
        outside = np.abs(scale) > self.reach * (1.0 + 1e-9)
        if outside.any():
            room = self.margin * (self.high - self.low)
            raise InvalidInput(
                f"{self.name} {array[outside].flat[0]:g} {self.unit} is outside the calibrated "
                f"{self.low - room:g} to {self.high + room:g} {self.unit}; calibrate over a wider "
                "range, or allow a margin"
            )
        return np.clip(scale, -self.reach, self.reach)

    def natural(self, scaled: FloatArray) -> FloatArray:
        """The values of scaled ones."""
        return np.asarray(0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * scaled)


def on_scale(axis: Axis, coefficients: ArrayLike) -> FloatArray:
    """A polynomial of the natural quantity as one of the scaled: p(natural(u)), same order."""
    natural = polynomial.Polynomial(np.asarray(coefficients, dtype=np.float64))
    middle, half = 0.5 * (axis.low + axis.high), 0.5 * (axis.high - axis.low)
    scaled = natural(polynomial.Polynomial([middle, half])).coef
    return np.pad(scaled, (0, len(natural.coef) - len(scaled)))


def check_columns(columns: dict[str, FloatArray]) -> None:
    """Refuses data that are not columns of one length."""
    shapes = {name: column.shape for name, column in columns.items()}
    if len(set(shapes.values())) > 1 or any(len(shape) != 1 for shape in shapes.values()):
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InvalidInput(f"calibration data must be columns of one length; shapes are {listed}")


def check_distinct(name: str, column: FloatArray, least: int) -> None:
    """Refuses data with too few different settings."""
    distinct = np.unique(column).size
    if distinct < least:
        raise InvalidInput(
            f"{name} has {distinct} different values in {column.size} points; this curve needs "
            f"{least} or more"
        )


def check_order(settings: FloatArray, response: FloatArray, name: str, unit: str) -> None:
    """Refuses readings that are not in the order of the settings.

    Neighbours are compared by their means. With repeats only a statistically significant reversal
    counts; without, any does, because noise is unknown.

    Args:
        settings: Shape (n, k); the last column is compared among points that agree in the others.
        response: Shape (n,).
        name: Of the last column, for the error.

    Raises:
        InvalidInput: a reversal.
    """
    distinct, group = np.unique(settings, axis=0, return_inverse=True)
    count = np.bincount(group.ravel())
    mean = np.bincount(group.ravel(), weights=response) / count
    error, repeats, _ = pure_error(response, settings)
    allowed = np.zeros(mean.size - 1)
    if repeats:
        from scipy.special import stdtrit  # noqa: PLC0415  slow to load

        t = float(stdtrit(repeats, _REVERSAL_LEVEL))
        allowed = t * np.sqrt(error / repeats * (1.0 / count[1:] + 1.0 / count[:-1]))
    comparable = (distinct[1:, :-1] == distinct[:-1, :-1]).all(axis=1)
    rise, apart = np.diff(mean), np.diff(distinct[:, -1])
    direction = np.sign(np.sum((rise * apart)[comparable]))
    reversed_ = comparable & (rise * direction < -allowed)
    if reversed_.any():
        i = int(np.flatnonzero(reversed_)[0])
        low, high = distinct[i : i + 2, -1]
        raise InvalidInput(
            f"the data are not monotone: {mean[i]:.6g} at {name} {low:g} {unit}, but "
            f"{mean[i + 1]:.6g} at {high:g} {unit}, against the trend; look for mixed-up rows, a "
            "slipped load or friction, or repeat each point to show that it is noise"
        )


def check_slope(coefficients: FloatArray, slope: float, half_width: float, where: str) -> None:
    """Refuses a curve that is not significantly monotone.

    Args:
        coefficients: Of the powers of the scaled variable, shape (k, ...); [1, 0] is the slope in
            the middle.
        slope: Slope at an extreme, per unit of the scaled variable.
        half_width: Of its confidence interval.
        where: The extreme, for the error.

    Raises:
        InvalidInput: the slope at the extreme has not, with confidence, the sign of that in the
            middle.
    """
    middle = float(coefficients[1, 0])
    if not abs(middle) > _FLAT * float(np.max(np.abs(coefficients))):
        raise InvalidInput(
            f"the fitted curve is flat: over the calibrated range it changes by {2.0 * middle:g}; "
            "check that the reading depends on the setting"
        )
    if not slope * math.copysign(1.0, middle) > half_width:
        raise InvalidInput(
            f"the fitted curve is not significantly monotone: at {where} its slope is "
            f"{slope / middle:.3g} +- {half_width / abs(middle):.2g} of that in the middle; "
            "calibrate a narrower range, take more points, or lower the order or margin"
        )


def extremes(slope: FloatArray, reach: float) -> list[float]:
    """Possible extremes of a polynomial on -reach..reach: ends and stationary points."""
    stationary = polynomial.polyroots(polynomial.polytrim(polynomial.polyder(slope)))
    inside = [float(r.real) for r in stationary if r.imag == 0.0 and abs(r.real) < reach]
    return [-reach, *inside, reach]


def check_between(
    name: str, values: FloatArray, end: FloatArray, other: FloatArray, axis: Axis
) -> None:
    """Raises InvalidInput for values that the curve does not take on its range."""
    low, high = np.minimum(end, other), np.maximum(end, other)
    rounding = 1e-9 * (high - low)
    outside = (values < low - rounding) | (values > high + rounding)
    if outside.any():
        values, low, high = np.broadcast_arrays(values, low, high)
        raise InvalidInput(
            f"{name} {values[outside].flat[0]:g} is outside {low[outside].flat[0]:g} to "
            f"{high[outside].flat[0]:g}, the result of the calibrated {axis.name} of "
            f"{axis.low:g} to {axis.high:g} {axis.unit}; calibrate over a wider range, or allow a "
            "margin"
        )
