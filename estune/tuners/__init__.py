"""The tuners: each proposes a point, is told what the trial there cost, and proposes the next.

A tuner is a value, its settings; what it has learnt is another, its state. Every method is pure,
so that the same state and observations give the same proposals bit for bit, in any process.
"""

from typing import Any, Protocol, TypeVar

from estune.tuners.killingsworth import Killingsworth
from estune.tuners.least_squares_gradient import LeastSquaresGradient
from estune.tuners.observation import Observation
from estune.tuners.otis import Otis
from estune.tuners.phase_compensated import PhaseCompensated
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import Point, SearchSpace


class TunerState(Protocol):
    """What every state tells; the rest of it is the tuner's own.

    A state is a NamedTuple of floats, ints, None and flat tuples of floats.
    """

    @property
    def best_point(self) -> Point:
        """Where the best safe trial was; the start until there was one."""
        ...

    @property
    def best_cost(self) -> float | None:
        """What it cost; None until there was one."""
        ...

    def _asdict(self) -> dict[str, Any]: ...


S = TypeVar("S", bound=TunerState)


class Tuner(Protocol[S]):
    """Ask for a point, run the trial there, tell what it cost; in turns.

    An observation that is censored takes the search back to where trials were safe and makes it
    more cautious, by the rule in `estune.tuners.step_scale`.
    """

    @property
    def name(self) -> str:
        """What the tuner is called, a key of `TUNERS`."""
        ...

    @property
    def space(self) -> SearchSpace:
        """What it tunes."""
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
        """The point to settle on: the centre of the search, without dither."""
        ...


TUNERS: dict[str, Any] = {
    "newton": SafeBayesianTuner,
    "killingsworth": Killingsworth,
    "otis": Otis,
    "phase_compensated": PhaseCompensated,
    "least_squares_gradient": LeastSquaresGradient,
}
"""The tuners by name. Each is made from a search space; every other setting has a default."""


def state_to_json(state: TunerState) -> dict[str, Any]:
    """A tuner's state as JSON values; floats survive exactly."""
    return state._asdict()


def state_from_json(tuner: Tuner[S], values: dict[str, Any]) -> S:
    """The state that `state_to_json` gave, for the tuner it belongs to."""
    kind = type(tuner.start())
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
