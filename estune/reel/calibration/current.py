"""Calibration of the current controller, C1; `estune.hardware.scales` has its inverse."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, Numbers, checked_array, scalar_or_array
from estune.errors import InvalidInput
from estune.reel.calibration.monotone import (
    Axis,
    check_columns,
    check_distinct,
    check_order,
    check_slope,
    extremes,
    on_scale,
)
from estune.reel.calibration.regression import Regression, Stored, regress


@dataclass(frozen=True, slots=True)
class CurrentCalibration(Stored):
    """The current controller C1: motor current as a polynomial of the commanded counts.

    Attributes:
        command: Calibrated range of the command, counts.
        regression: The fit; coefficients are those of u^k, u the scaled command; residuals in A.

    Raises:
        InvalidInput: the curve is not monotone within its range.
    """

    command: Axis
    regression: Regression

    def __post_init__(self) -> None:
        c = np.asarray(self.regression.coefficients)
        slope = polynomial.polyder(c)
        for u in extremes(slope, self.command.reach):
            row = np.concatenate([[0.0], np.arange(1, c.size) * u ** np.arange(c.size - 1)])
            check_slope(
                c[:, None],
                float(polynomial.polyval(u, slope)),
                self.regression.half_width(row),
                f"command {self.command.natural(np.asarray(u)):g}",
            )

    @classmethod
    def fit(
        cls, command: ArrayLike, current_A: ArrayLike, *, order: int = 3, margin: float = 0.0
    ) -> Self:
        """Calibrates the current controller from commanded counts and measured currents.

        Args:
            command: Counts commanded, shape (n,); repeat some for the lack-of-fit test.
            current_A: Motor current measured, A, shape (n,).
            order: Order of the polynomial, one or more.
            margin: Accepted excess beyond either end, as a share of the range.

        Raises:
            InvalidInput: values not finite or not of one shape, too few or too few different
                points, points that do not determine the coefficients, or currents that do not
                rise, or fall, with the command throughout.
        """
        counts, current = (
            checked_array("command", command, "counts"),
            checked_array("current_A", current_A, "A"),
        )
        check_columns({"command": counts, "current_A": current})
        if order < 1:
            raise InvalidInput(f"order is {order}; a current calibration has order 1 or more")
        check_distinct("command", counts, order + 1)
        axis = Axis("command", "counts", float(counts.min()), float(counts.max()), margin)
        design = axis.scaled(counts)[:, None] ** np.arange(order + 1)
        fitted = regress(design, current, counts[:, None])
        check_order(counts[:, None], current, "command", "counts")
        return cls(axis, fitted)

    @classmethod
    def from_polynomial(
        cls, amperes_of_command: ArrayLike, low: float, high: float, *, margin: float = 0.0
    ) -> Self:
        """C1 from the exact numbers of a data sheet.

        Args:
            amperes_of_command: Offset in A, A per count, and further powers; two or more numbers.
            low: Least command of the valid range, counts.
            high: Greatest.
            margin: Accepted excess beyond either end, as a share of the range.

        Raises:
            InvalidInput: fewer than two finite numbers, no range, or a curve that is not monotone
                on it.
        """
        given = checked_array("amperes_of_command", amperes_of_command, "A")
        if given.ndim != 1 or given.size < 2:
            raise InvalidInput(
                f"amperes_of_command has shape {given.shape}; give offset, slope and "
                "optionally further powers"
            )
        axis = Axis("command", "counts", low, high, margin)
        return cls(axis, Regression.exact(on_scale(axis, given).tolist()))

    def current_A(self, command: ArrayLike) -> Numbers:
        """Current that a command gives, A.

        Raises:
            InvalidInput: a value is not finite or outside the calibrated range.
        """
        return scalar_or_array(self._curve(self.command.scaled(command)))

    def _curve(self, u: FloatArray) -> FloatArray:
        return np.asarray(polynomial.polyval(u, np.asarray(self.regression.coefficients)))
