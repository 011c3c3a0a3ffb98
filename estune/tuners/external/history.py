"""What a tuner of another library has learnt: every trial it was told of, and nothing else."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from estune.tuners.observation import Observation, log_cost
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.step_scale import Best, best_after


class History(NamedTuple):
    """The trials told, in their order.

    Attributes:
        coordinates: Where they were, one trial's after the other's.
        levels: Logarithms of their costs; infinite where a trial was censored.
        best_point: Where the best safe trial was; the start until there was one.
        best_cost: What it cost; None until there was one.
    """

    coordinates: tuple[float, ...]
    levels: tuple[float, ...]
    best_point: Point
    best_cost: float | None

    def trials(self, first: int = 0) -> Iterator[tuple[Coordinates, float]]:
        """Coordinates and level of each trial, from the given one on."""
        parameters = len(self.best_point)
        for n in range(first, len(self.levels)):
            yield self.coordinates[n * parameters : (n + 1) * parameters], self.levels[n]


def begun(space: SearchSpace) -> History:
    """The history before the first trial."""
    return History((), (), space.start, None)


def with_trial(
    history: History, space: SearchSpace, coordinates: Coordinates, observation: Observation
) -> History:
    """The history with one more trial.

    Args:
        history: That of the trials before it.
        space: What is tuned.
        coordinates: Where the trial was, as it was proposed: the logarithm of what it was rounds
            otherwise.
        observation: What came of it.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    told = (*history.coordinates, *coordinates)
    if observation.censored:
        return history._replace(coordinates=told, levels=(*history.levels, math.inf))
    best = Best(history.best_point, history.best_cost)
    best = best_after(best, space.point(coordinates), observation)
    return History(told, (*history.levels, log_cost(observation)), best.point, best.cost)
