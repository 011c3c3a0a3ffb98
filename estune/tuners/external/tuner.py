"""A tuner around another library's optimiser: what it learns is the history of its trials."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from estune.tuners.external.history import History, begun, with_trial
from estune.tuners.external.optimiser_cache import Optimiser, proposal
from estune.tuners.observation import Observation
from estune.tuners.search_space import Coordinates, Point, SearchSpace


@dataclass(frozen=True, slots=True)
class ExternalTuner(ABC):
    """What tuners of other libraries share: all but the optimiser that proposes.

    Attributes:
        space: What is tuned.
    """

    space: SearchSpace

    @abstractmethod
    def optimiser(self) -> Optimiser:
        """One with these settings that has been told of nothing."""

    def start(self) -> History:
        """The state before the first trial."""
        return begun(self.space)

    def ask(self, state: History) -> Point:
        """The point of the next trial, within the bounds."""
        return self.space.point(self._proposed(state))

    def tell(self, state: History, observation: Observation) -> History:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        return with_trial(state, self.space, self._proposed(state), observation)

    def recommend(self, state: History) -> Point:
        """The best safe point tried."""
        return state.best_point

    def _proposed(self, state: History) -> Coordinates:
        if not state.levels:
            return self.space.coordinates(self.space.start)
        return proposal(self, state, self.optimiser)
