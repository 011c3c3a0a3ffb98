"""The observation that a tuner receives of each trial it asked for."""

import math
from typing import NamedTuple

from estune.errors import InvalidInput
from estune.loop_model.records import LoopRecord


class Observation(NamedTuple):
    """The outcome of one trial, as far as a tuner is concerned.

    Attributes:
        cost: The cost of the trial; without meaning where it is censored.
        censored: The trial was unsafe: over eta_max, aborted, or without a finite cost. It only
            marks its gains as unsafe.
        margin: Constraint margin: the least share that the trial left of any of the rig's limits;
            1 far away, 0 at the limit.
        record: Signals of the trial, for tuners that identify the loop; None without them.
    """

    cost: float
    censored: bool = False
    margin: float = math.inf
    record: LoopRecord | None = None


COST_LIMIT = 1e100
"""Greater costs count as this, so that no arithmetic on them overflows."""


def usable_cost(observation: Observation) -> float:
    """The cost of an uncensored observation, clipped to COST_LIMIT.

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
    """The logarithm of the cost, so that the unit of the cost does not matter to a tuner.

    A cost at or below zero, which (35) never has, counts as 1/COST_LIMIT.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    return math.log(max(usable_cost(observation), 1.0 / COST_LIMIT))


def usable_margin(observation: Observation) -> float:
    """The constraint margin, from -1 to 1; at most 0 after an unsafe trial.

    Raises:
        InvalidInput: the margin is not a number.
    """
    margin = observation.margin
    if math.isnan(margin):
        raise InvalidInput("margin is nan; leave it out where no limit is known")
    most = 0.0 if observation.censored else 1.0
    return max(min(margin, most), -1.0)
