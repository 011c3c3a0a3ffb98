"""Calibration of the strain gauge, C2, from counts to force and back."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, Numbers, checked_array, scalar_or_array
from estune.errors import InvalidInput
from estune.reel.calibration.monotone import (
    Axis,
    check_between,
    check_columns,
    check_distinct,
    check_order,
    check_slope,
    extremes,
    on_scale,
)
from estune.reel.calibration.regression import Regression, Stored, regress


@dataclass(frozen=True, slots=True)
class GaugeCalibration(Stored):
    """The strain gauge: counts as a polynomial of second order in force, of order N in position.

    Without a position it is the quadratic C2. With one, it is the 2 x N polynomial for a cable
    that bends over the gauge at a moving contact point.

    Attributes:
        force: Calibrated range of the force.
        position: Calibrated range of the contact position; None for C2.
        regression: The fit; coefficients are those of u^i v^j, i = 0, 1, 2 slow and j = 0..N fast,
            u and v being the scaled force and position; residuals are in counts.

    Raises:
        InvalidInput: the curve is not monotone in force within its range.
    """

    force: Axis
    position: Axis | None
    regression: Regression

    def __post_init__(self) -> None:
        count = len(self.regression.coefficients)
        if count < 3 or count % 3 or (self.position is None) != (count == 3):
            raise InvalidInput(
                f"a gauge calibration {'without' if self.position is None else 'with'} position "
                f"cannot have {count} coefficients; calibrate again"
            )
        c = self._matrix()
        # The slope c1(v) + 2 u c2(v) is linear in u: extreme at both ends of u, and there at the
        # ends of v or where it is stationary in v.
        for u in (-self.force.reach, self.force.reach):
            slope = c[1] + 2.0 * u * c[2]
            for v in extremes(slope, 1.0 if self.position is None else self.position.reach):
                at_u, at_v = np.asarray(u), np.asarray(v)
                row = _rows(at_u, at_v, c.shape[1] - 1, slope=True)
                where = f"force {self.force.natural(at_u):g} N"
                if self.position is not None:
                    where += f", position {self.position.natural(at_v):g} m"
                check_slope(
                    c,
                    float(polynomial.polyval(v, slope)),
                    self.regression.half_width(row),
                    where,
                )

    @classmethod
    def fit(
        cls,
        force_N: ArrayLike,
        reading: ArrayLike,
        position_m: ArrayLike | None = None,
        *,
        position_order: int = 0,
        margin: float = 0.0,
    ) -> Self:
        """Calibrates a gauge from known forces.

        Args:
            force_N: Force applied, N, shape (n,). Repeat forces for the lack-of-fit test; load
                and unload to reveal hysteresis.
            reading: Counts read, shape (n,).
            position_m: Contact position, m, shape (n,); None for C2.
            position_order: N; one or more with a position.
            margin: Accepted excess beyond either end, as a share of the ranges.

        Raises:
            InvalidInput: values not finite or not of one shape, too few or too few different
                points, points that do not determine the coefficients, or readings that do not
                rise, or fall, with force throughout.
        """
        force, counts = (
            checked_array("force_N", force_N, "N"),
            checked_array("reading", reading, "counts"),
        )
        check_columns({"force_N": force, "reading": counts})
        check_distinct("force_N", force, 3)
        if (position_m is None) != (position_order == 0) or position_order < 0:
            raise InvalidInput(
                f"position_order is {position_order} "
                f"{'without' if position_m is None else 'with'} positions; "
                "it is 1 or more with them and 0 without"
            )
        axis = Axis("force", "N", float(force.min()), float(force.max()), margin)
        u = axis.scaled(force)
        along, v, settings = None, np.zeros_like(u), force[:, None]
        if position_m is not None:
            position = checked_array("position_m", position_m, "m")
            check_columns({"force_N": force, "position_m": position})
            check_distinct("position_m", position, position_order + 1)
            along = Axis("position", "m", float(position.min()), float(position.max()), margin)
            v, settings = along.scaled(position), np.column_stack([position, force])
        fitted = regress(_rows(u, v, position_order), counts, settings)
        check_order(settings, counts, "force", "N")
        return cls(axis, along, fitted)

    @classmethod
    def from_polynomial(
        cls, counts_of_force: ArrayLike, low_N: float, high_N: float, *, margin: float = 0.0
    ) -> Self:
        """C2 from the exact numbers of a data sheet.

        Args:
            counts_of_force: Offset in counts, counts per N, and optionally counts per N^2.
            low_N: Least force of the valid range, N.
            high_N: Greatest.
            margin: Accepted excess beyond either end, as a share of the range.

        Raises:
            InvalidInput: not two or three finite numbers, no range, or a curve that is not
                monotone on it.
        """
        given = checked_array("counts_of_force", counts_of_force, "counts")
        if given.shape not in ((2,), (3,)):
            raise InvalidInput(
                f"counts_of_force has shape {given.shape}; give offset, slope and, if there is "
                "one, curvature"
            )
        axis = Axis("force", "N", low_N, high_N, margin)
        scaled = on_scale(axis, np.pad(given, (0, 3 - given.size)))
        return cls(axis, None, Regression.exact(scaled.tolist()))

    def reading(self, force_N: ArrayLike, position_m: ArrayLike | None = None) -> Numbers:
        """Counts that a force gives; shapes broadcast.

        Raises:
            InvalidInput: a value is not finite or outside the calibrated range.
        """
        u, v = self.force.scaled(force_N), self._along(position_m)
        zero, one, two = self._in_force(v)
        return scalar_or_array(zero + u * (one + u * two))

    def force_N(self, reading: ArrayLike, position_m: ArrayLike | None = None) -> Numbers:
        """Force that gives these counts, N; shapes broadcast.

        Raises:
            InvalidInput: a value is not finite, or counts that no calibrated force gives.
        """
        counts, v = checked_array("reading", reading, "counts"), self._along(position_m)
        zero, one, two = self._in_force(v)
        reach = self.force.reach
        check_between(
            "reading",
            counts,
            zero - reach * (one - reach * two),
            zero + reach * (one + reach * two),
            self.force,
        )
        root = np.sqrt(np.maximum(one * one + 4.0 * two * (counts - zero), 0.0))
        # This form of the quadratic's root neither cancels nor fails for a straight line.
        u = 2.0 * (counts - zero) / (one + np.copysign(root, one))
        return scalar_or_array(self.force.natural(np.clip(u, -reach, reach)))

    def _matrix(self) -> FloatArray:
        return np.asarray(self.regression.coefficients).reshape(3, -1)

    def _in_force(self, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of u^0, u^1 and u^2 at a scaled position."""
        zero, one, two = (np.asarray(polynomial.polyval(v, row)) for row in self._matrix())
        return zero, one, two

    def _along(self, position_m: ArrayLike | None) -> FloatArray:
        if (position_m is None) != (self.position is None):
            needed = "needs a contact position" if self.position else "has no contact position"
            raise InvalidInput(f"this gauge calibration {needed}")
        if self.position is None or position_m is None:
            return np.asarray(0.0)
        return self.position.scaled(position_m)


def _rows(u: FloatArray, v: FloatArray, order: int, *, slope: bool = False) -> FloatArray:
    """The gauge's design, or its derivative by u, shape (..., 3 (order + 1))."""
    in_force = [np.zeros_like(u), np.ones_like(u), 2.0 * u] if slope else [u**0, u, u * u]
    in_position = v[..., None] ** np.arange(order + 1)
    rows = np.stack(in_force, axis=-1)[..., :, None] * in_position[..., None, :]
    return np.asarray(rows.reshape(*rows.shape[:-2], -1))
