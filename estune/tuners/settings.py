"""Checks of the settings that tuners share."""

from estune.errors import InvalidInput
from estune.tuners.search_space import SearchSpace


def check_below_one(tuner: str, setting: str, value: float) -> None:
    """Raises InvalidInput unless the value lies between zero and one."""
    if not 0.0 < value < 1.0:  # refuses NaN too
        raise InvalidInput(f"{tuner}: {setting} is {value}; it must lie between 0 and 1")


def check_logarithmic(tuner: str, space: SearchSpace) -> None:
    """Raises InvalidInput unless the search space has a logarithmic scale."""
    if space.scale != "log":
        raise InvalidInput(
            f"{tuner}: the search space is {space.scale}, but this tuner steps in logarithms; "
            'use scale="log" with lower bounds above zero'
        )
