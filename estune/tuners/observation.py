"""What a tuner is told about the trial it asked for."""

import math
from typing import NamedTuple

from estune.errors import InvalidInput


class Observation(NamedTuple):
    """The outcome of one trial, as far as a tuner is concerned.

    Attributes:
        cost: The cost of the trial; means nothing where it is censored.
        censored: The trial was unsafe: over eta_max, aborted, or without a finite cost. All it
            says is that its gains are to be kept away from.
        margin: The smallest share the trial left of any of the rig's limits: 1 far away, 0 at it.
    """

    cost: float
    censored: bool = False
    margin: float = math.inf


COST_LIMIT = 1e100
"""Costs beyond this count as this, so that no arithmetic on them overflows."""


def usable_cost(observation: Observation) -> float:
    """The cost of an uncensored observation, within what arithmetic can bear.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    cost = observation.cost
    if not math.isfinite(cost):
        raise InvalidInput(
            f"cost {cost} is not finite; tell a trial without a cost as censored=True"
        )
    return min(max(cost, -COST_LIMIT), COST_LIMIT)


def log_cost(observation: Observation) -> float:
    """The logarithm of the cost, which makes a tuner indifferent to the unit of the cost.

    A cost at or below zero, which (35) never has, counts as 1/COST_LIMIT.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    return math.log(max(usable_cost(observation), 1.0 / COST_LIMIT))


def usable_margin(observation: Observation) -> float:
    """The margin of an observation: at most one, however far away the limits are.

    A trial that was unsafe had none left, unless it says so itself.

    Raises:
        InvalidInput: the margin is not a number.
    """
    margin = observation.margin
    if math.isnan(margin):
        raise InvalidInput("margin is nan; leave it out where no limit is known")
    if observation.censored:
        return max(min(margin, 0.0), -1.0)
    return max(min(margin, 1.0), -1.0)
