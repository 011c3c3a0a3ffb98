"""Checks that the tuners' settings share."""

import math

from estune.errors import InvalidInput
from estune.tuners.search_space import SearchSpace


def check_above_zero(tuner: str, what: str, value: float) -> None:
    """Refuses what is not a finite number above zero.

    Raises:
        InvalidInput: it is not.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidInput(f"{tuner}: {what} is {value}; it must be finite and above zero")


def check_below_one(tuner: str, what: str, value: float) -> None:
    """Refuses what does not lie between zero and one.

    Raises:
        InvalidInput: it does not.
    """
    if not 0.0 < value < 1.0:  # refuses NaN too
        raise InvalidInput(f"{tuner}: {what} is {value}; it must lie between 0 and 1")


def check_logarithmic(tuner: str, space: SearchSpace) -> None:
    """Refuses a search space on a linear scale.

    Raises:
        InvalidInput: it is on one.
    """
    if space.scale != "log":
        raise InvalidInput(
            f"{tuner}: the search space is {space.scale}, but this tuner steps in logarithms; "
            'use scale="log" with lower bounds above zero'
        )
