"""The interface of a tuner: it proposes a point, takes in the cost of the trial, and so on.

A tuner is a value, its settings; what it has learnt is another, its state. Every method is pure:
the same state and observations give the same proposals bit for bit, in any process.
"""

from typing import Any, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.tuners.observation import Observation
from estune.tuners.search_space import Point, SearchSpace


class TunerState(Protocol):
    """The fields every state has; the others are the tuner's own.

    A state is a NamedTuple of floats, ints, None and flat tuples of floats.
    """

    @property
    def best_point(self) -> Point:
        """The point of the best safe trial; the start until there was one."""
        ...

    @property
    def best_cost(self) -> float | None:
        """Its cost; None until there was one."""
        ...


S = TypeVar("S", bound=TunerState)


class Tuner(Protocol[S]):
    """Ask for a point, run the trial there, tell its cost; in turns.

    A censored observation takes the search back to safe points and shortens its steps, by the rule
    in `estune.tuners.step_control`.
    """

    @property
    def name(self) -> str:
        """Its registered name; the user's choice for a user's own tuner."""
        ...

    @property
    def space(self) -> SearchSpace:
        """The tuned parameters."""
        ...

    def start(self) -> S:
        """The state before the first trial."""
        ...

    def ask(self, state: S) -> Point:
        """The point of the next trial, within the bounds, dither included."""
        ...

    def tell(self, state: S, observation: Observation) -> S:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        ...

    def recommend(self, state: S) -> Point:
        """The centre of the search, without dither."""
        ...


class ConvergenceEstimate(NamedTuple):
    """The state of convergence, by the tuner's own model of the cost.

    Attributes:
        noise: Standard deviation of one trial's cost, relative to it.
        remaining_improvement: Upper 95 % bound of the improvement still possible: the excess of
            the recommended point's cost over the optimum within the bounds, relative to it.
        expected_improvement: The mean of the same quantity.
        intervals: 95 % interval of the optimum of each parameter, in its own unit and the order
            of `SearchSpace.names`; reaches to the bounds along a flat direction.
        condition: Under what the bound holds, in words; empty where nothing stands against it.
    """

    noise: float
    remaining_improvement: float
    expected_improvement: float
    intervals: tuple[tuple[float, float], ...]
    condition: str = ""

    @property
    def sentence(self) -> str:
        """The remaining improvement in words."""
        most = f"the remaining improvement is at most {self.remaining_improvement:.1%}"
        return most + (f" {self.condition}" if self.condition else "")


class CostPrediction(NamedTuple):
    """The cost that a tuner predicts for a point.

    Attributes:
        low: Lower end of its 95 % interval for the mean of repeats.
        explored: Whether the point lies within the region that safe trials have shown to be safe.
    """

    cost: float
    low: float
    high: float
    explored: bool


@runtime_checkable
class PredictingTuner(Protocol):
    """A tuner with a model of the cost: predictions and a convergence estimate."""

    def convergence(self, state: Any) -> ConvergenceEstimate | None:
        """The state of convergence; None while too little is known."""
        ...

    def predict(self, state: Any, point: Point) -> CostPrediction:
        """The cost predicted at a point."""
        ...


@runtime_checkable
class EndingTuner(Protocol):
    """A predicting tuner that tells cheaply whether its convergence is worth estimating."""

    def may_end(self, state: Any, tolerance: float) -> bool:
        """Whether the remaining improvement may be below the tolerance."""
        ...


@runtime_checkable
class RecordUsingTuner(Protocol):
    """A tuner that learns from the signals of each record, not from its cost alone.

    Its observations carry the record.
    """

    @property
    def limits(self) -> RobustnessLimits:
        """Limits that its gains keep."""
        ...

    def would_repeat(self, state: Any, tolerance: float) -> bool:
        """Whether the next trial would tell what an earlier one told, by the identified loop."""
        ...

    def tell_start(self, state: Any, observation: Observation) -> Any:
        """The state after a trial of the initial gains, before the first proposal."""
        ...

    def unknown_loop(self, state: Any) -> UnknownLoop | None:
        """The loop at the next point, where more excitation would tell more of it; else None."""
        ...

    def tell_excitation(self, state: Any, record: LoopRecord) -> Any:
        """The state after a trial that excites the loop, which has no cost."""
        ...

    def is_predicted(self, state: Any) -> bool:
        """Whether its model predicts the costs, so that the recommendation rests on all trials."""
        ...

    def for_trial(self, trial: StepTrial, limits: RobustnessLimits | None) -> Self:
        """The tuner for a step trial; without limits with its own."""
        ...
