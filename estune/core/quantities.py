"""Checks of numbers given by the user: one float, or an array of any shape."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estune.errors import InvalidInput

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
Numbers = Any
"""A float, or an array of float64: scalars in, scalars out."""


SMALLEST = 1e-150
"""Smallest number that counts as above zero: its square and its reciprocal are numbers."""


def check_positive(name: str, value: float, unit: str = "") -> None:
    """Raises InvalidInput unless the value is finite and above zero."""
    # Not `value < SMALLEST`, which is false of NaN.
    if not (_is_finite(name, value) and value >= SMALLEST):
        raise InvalidInput(
            f"{name} is {value}{unit and ' ' + unit}; it must be finite and above zero"
        )


def check_not_negative(name: str, value: float, unit: str = "") -> None:
    """Raises InvalidInput unless the value is finite, and zero or above."""
    if not (_is_finite(name, value) and value >= 0.0):
        raise InvalidInput(
            f"{name} is {value}{unit and ' ' + unit}; it must be finite, and zero or above"
        )


def _is_finite(name: str, value: float) -> bool:
    """Whether a value is finite.

    Raises:
        InvalidInput: it is not a number.
    """
    try:
        return math.isfinite(value)
    except TypeError:
        raise InvalidInput(f"{name} is {value!r}; it must be a number, without its unit") from None


def checked_array(
    name: str,
    values: ArrayLike,
    unit: str,
    *,
    above: float = -np.inf,
    least: float = -np.inf,
) -> FloatArray:
    """The values as an array of float64.

    Args:
        name: Name of the quantity, for the error.
        values: The values, any shape.
        above: Bound that every value must exceed.
        least: Least value allowed.

    Raises:
        InvalidInput: a value is not a number, not finite or out of range.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{name} must be a number or an array of numbers: {error}") from None
    limit = f"above {above:g}" if np.isfinite(above) else f"{least:g} or more"
    ranged = f"finite and {limit} {unit}" if np.isfinite(max(above, least)) else "finite"
    good = np.isfinite(array) & (array > above) & (array >= least)
    refuse_where(~good, name, array, unit, f"it must be {ranged}")
    return array


def refuse_where(bad: BoolArray, name: str, array: FloatArray, unit: str, remedy: str) -> None:
    """Raises InvalidInput with the first bad value, its index, and the remedy."""
    if bad.any():
        place = first_index(bad)
        value = f"{array[place]:g}{unit and ' ' + unit}"
        raise InvalidInput(f"{name} is {value}{index_text(place)}; {remedy}")


def first_index(mask: BoolArray) -> tuple[int, ...]:
    """Index of the first true element."""
    return tuple(int(i) for i in np.argwhere(mask)[0])


def index_text(place: tuple[int, ...]) -> str:
    """The index as text, empty for a scalar."""
    return f" at index {', '.join(map(str, place))}" if place else ""


def scalar_or_array(array: FloatArray) -> Numbers:
    """A float where the array has no dimensions, else the array."""
    return array.item() if array.ndim == 0 else array
