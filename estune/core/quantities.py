"""Numbers given by the user: one float or an array of any shape, checked once."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estune.errors import InvalidInput

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Numbers = Any
"""A float, or an array of float64: scalars in, scalars out."""


def checked(
    name: str,
    values: ArrayLike,
    unit: str,
    *,
    above: float = -np.inf,
    least: float = -np.inf,
) -> FloatArray:
    """The values as an array of float64.

    Args:
        name: What they are, for the error.
        values: The values, any shape.
        unit: Their unit, for the error.
        above: They must be greater than this.
        least: They must not be less than this.

    Raises:
        InvalidInput: a value is not a number, not finite or out of range.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{name} must be a number or an array of numbers: {error}") from None
    good = np.isfinite(array) & (array > above) & (array >= least)
    if not good.all():
        place = first(~good)
        limit = f"above {above:g}" if np.isfinite(above) else f"{least:g} or more"
        ranged = f"finite and {limit} {unit}" if np.isfinite(max(above, least)) else "finite"
        raise InvalidInput(f"{name} is {array[place]:g} {unit}{at(place)}; it must be {ranged}")
    return array


def first(mask: BoolArray) -> tuple[int, ...]:
    """Index of the first place where the mask holds."""
    return tuple(int(i) for i in np.argwhere(mask)[0])


def at(place: tuple[int, ...]) -> str:
    """The place in words, empty for a scalar."""
    return f" at index {', '.join(map(str, place))}" if place else ""


def plain(array: FloatArray) -> Numbers:
    """A float where the array has no dimensions, else the array."""
    return array.item() if array.ndim == 0 else array
