"""Makes any tuner a tuner of schedules: each proposal is tried once at every length, in turn.

With eta_j the cost at the j-th of m lengths, the tuner inside is told of the geometric mean

    ln eta = (1/m) sum_j ln eta_j

of each block of m trials. A length's own level, however high, only adds a constant to it, and so
moves its lowest point nowhere: no length needs a weight. Trial n is at the length n mod m, so that
any m trials in a row are a block. An unsafe one ends its block at once, and the tuner is told: its
gains are not tried at the other lengths.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.studies.joint.schedule_space import ScheduleSpace
from estune.tuners import TUNERS, Tuner, create_tuner
from estune.tuners.observation import Observation, log_cost
from estune.tuners.search_space import Point, SearchSpace


class ScheduleTunerState(NamedTuple):
    """Where the search stands before trial k."""

    k: int
    inner: Any  # the state of the tuner inside
    logs: tuple[float, ...]  # logarithms of the costs of the block under way
    best_point: Point  # the start: no single gains are the answer
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class ScheduleTuner:
    """A tuner, in the sense of `estune.tuners`, whose gains depend on the trial's length.

    A run confirms gains, and a schedule is no one set of gains: what it recommends to the run is
    the start, and its schedule is confirmed by its own last trials, the checks.

    Attributes:
        start_gains: The same at every length.
        length_m: The lengths, in the order of the trials, m.
        straight: Gains that may change with length.
        inside: Name of the tuner inside.
        search_trials: Trials of the search; those after it check the schedule found.
        name: What the tuner is called.

    Raises:
        InvalidInput: there is no such tuner, or fewer than two lengths, or as for the space.
    """

    start_gains: Gains
    length_m: tuple[float, ...]
    straight: tuple[str, ...]
    inside: str
    search_trials: int
    name: Literal["schedule"] = "schedule"

    def __post_init__(self) -> None:
        if self.inside not in TUNERS:
            raise InvalidInput(
                f"there is no tuner {self.inside!r}; the tuners are {', '.join(TUNERS)}"
            )
        if len(set(self.length_m)) < 2:
            raise InvalidInput(
                f"a schedule over {self.length_m} m: give reels of two lengths at least"
            )
        _inside(self)  # refuses a space that cannot be

    @property
    def space(self) -> SearchSpace:
        """What gains may be asked for."""
        return SearchSpace.around(self.start_gains)

    @property
    def schedules(self) -> ScheduleSpace:
        """What the tuner inside steps in."""
        return ScheduleSpace.over(
            self.start_gains, (min(self.length_m), max(self.length_m)), self.straight
        )

    def start(self) -> ScheduleTunerState:
        """The state before the first trial."""
        return ScheduleTunerState(0, _inside(self).start(), (), self.start_gains.as_tuple(), None)

    def ask(self, state: ScheduleTunerState) -> Point:
        """The gains of the next trial, at its length."""
        length = self.length_m[state.k % len(self.length_m)]
        gains = self.schedules.gains_at(self._proposal(state), length)
        return self.space.point(self.space.coordinates(gains.as_tuple()))

    def tell(self, state: ScheduleTunerState, observation: Observation) -> ScheduleTunerState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        after = state._replace(k=state.k + 1)
        if state.k >= self.search_trials:
            return after
        if observation.censored:
            inner = _inside(self).tell(state.inner, observation)
            return after._replace(inner=inner, logs=())
        logs = (*state.logs, log_cost(observation))
        if len(logs) < len(self.length_m):
            return after._replace(logs=logs)
        seen = observation._replace(cost=math.exp(math.fsum(logs) / len(logs)))
        inner = _inside(self).tell(state.inner, seen)
        return after._replace(inner=inner, logs=(), best_cost=inner.best_cost)

    def recommend(self, state: ScheduleTunerState) -> Point:
        """The start; see the class."""
        return state.best_point

    def recommended(self, state: ScheduleTunerState) -> Point:
        """The schedule to settle on, a point of `schedules`."""
        return _inside(self).recommend(state.inner)

    def _proposal(self, state: ScheduleTunerState) -> Point:
        if state.k >= self.search_trials:
            return self.recommended(state)
        return _inside(self).ask(state.inner)


@lru_cache(maxsize=32)
def _inside(tuner: ScheduleTuner) -> Tuner[Any]:
    """The tuner inside; made once, for its space is asked for at every step."""
    made: Tuner[Any] = create_tuner(tuner.inside, tuner.schedules)
    return made
