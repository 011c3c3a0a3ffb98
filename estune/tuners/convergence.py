"""What a tuner knows about where its search stands: the noise, what is left to gain, how sure."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

from estune.tuners.search_space import Point


class ConvergenceEstimate(NamedTuple):
    """How a search stands, by the tuner's own model of the cost.

    Attributes:
        noise: Standard deviation of one trial's cost, relative to it.
        remaining: Upper 95 % bound of what is left to gain: by how much, relative to its cost,
            the recommended point may still lie above the optimum within the bounds.
        expected: The same in the mean.
        intervals: 95 % interval of the optimum of each parameter, in its own unit and the order
            of `SearchSpace.names`; reaches to the bounds along a direction that is flat.
    """

    noise: float
    remaining: float
    expected: float
    intervals: tuple[tuple[float, float], ...]


class CostPrediction(NamedTuple):
    """What a tuner expects of a point not tried yet.

    Attributes:
        cost: Expected cost.
        low: Lower end of its 95 % interval for the mean of repeats.
        high: Upper end.
        explored: Whether the point lies within what safe trials have shown to be safe.
    """

    cost: float
    low: float
    high: float
    explored: bool


@runtime_checkable
class ModelBasedTuner(Protocol):
    """A tuner that has a model of the cost, and tells what it makes of it."""

    def outlook(self, state: Any) -> ConvergenceEstimate | None:
        """Where the search stands; None while too little is known."""
        ...

    def forecast(self, state: Any, point: Point) -> CostPrediction:
        """What is expected of a point."""
        ...
