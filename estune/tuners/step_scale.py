"""What every tuner does about a trial that was unsafe (the paper's guard, eta < eta_max).

The tuner's caution, a number that multiplies the dither and the steps, falls by 30 %. It recovers
by 5 % with every safe trial, up to one: eight safe trials make up for an unsafe one. A tuner that
keeps no trials puts its centre back on the best safe point seen, and its filters or its regression
begin anew.
"""

from typing import NamedTuple

from estune.tuners.observation import Observation, usable_cost
from estune.tuners.search_space import Point

CAUTION_LEAST = 1.0 / 64.0
"""Below this the dither would tell nothing from noise."""


class Best(NamedTuple):
    """The best safe trial so far."""

    point: Point
    cost: float | None  # None until there was a safe trial; the point is the start until then


def best_after(best: Best, point: Point, observation: Observation) -> Best:
    """The best safe trial, once a safe trial has been told.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    cost = usable_cost(observation)
    return Best(point, cost) if best.cost is None or cost < best.cost else best


def shrink_after_unsafe(caution: float) -> float:
    """The caution after an unsafe trial."""
    return max(0.7 * caution, CAUTION_LEAST)


def recover_after_safe(caution: float) -> float:
    """The caution after a safe trial."""
    return min(1.05 * caution, 1.0)
