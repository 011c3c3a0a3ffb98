"""A control chart on the cost of check trials: tells drift from noise and from one bad trial.

The logarithm of the cost is charted, for its scatter is in proportion to it. Each new value x_n is
first turned into a standard normal one by what is known so far (Quesenberry 1991),

    q_n = Phi^-1( F_t( (x_n - mean) / (s sqrt(1 + 1/n)) ; nu ) ),

with mean and s of the values before it, s having nu degrees of freedom. While nothing changes the
q_n are independent and exactly normal however few values came before, so that the rate of false
alarms does not depend on a baseline of a few repeats having been lucky. They are smoothed,

    z_n = (1 - lambda) z_(n-1) + lambda q_n,    z_0 = 0,    alarm where |z_n| > h,

an exponentially weighted moving average (Roberts 1959). The limit h follows from the mean number
of trials between false alarms, the average run length L(0), where (Crowder 1987)

    L(u) = 1 + 1/lambda int_-h^h L(y) phi((y - (1 - lambda) u) / lambda) dy.

The baseline goes on learning, but only while z is near zero, so that it does not follow a drift;
false alarms become a little rarer by it. A drift that sets in while the baseline is of few values
can be taken into it all the same: let there be a dozen or two before there is time for a drift.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.errors import InvalidInput

LEARNT = 100
"""After so many values the baseline is known well enough, and no longer follows."""

CALM = 0.3
"""Only while |z| is within this share of its limit does the baseline learn: no drift is learnt."""

NODES = 64
"""Points of the Gauss-Legendre rule: the run length is then exact to more than six digits."""


class ChartSignal(StrEnum):
    """What the newest trial says, together with those before it."""

    STEADY = "steady"
    SUSPECT = "suspect"
    OUTLIER = "outlier"
    WORSE = "worse"
    BETTER = "better"

    @property
    def sentence(self) -> str:
        """The same in words."""
        return _SENTENCES[self]


_SENTENCES = {
    ChartSignal.STEADY: "the cost is what it was",
    ChartSignal.SUSPECT: "the cost is far from what it was; the trial is repeated before it counts",
    ChartSignal.OUTLIER: "the trial before was a single bad one and does not count",
    ChartSignal.WORSE: "the cost has risen beyond its scatter",
    ChartSignal.BETTER: "the cost has fallen beyond its scatter",
}


class ChartState(NamedTuple):
    """Where a chart stands.

    Attributes:
        known: Values that the mean is of.
        mean: Mean of the log cost while nothing had changed.
        squares: Sum of squares about the means that the scatter is taken from.
        freedom: Its degrees of freedom.
        smoothed: z.
        suspect: -1 or 1 where the trial before was far off, below or above; else 0.
    """

    known: int
    mean: float
    squares: float
    freedom: int
    smoothed: float = 0.0
    suspect: int = 0


@dataclass(frozen=True, slots=True)
class ControlChart:
    """The settings of a chart; `begin` and `tell` make and move its state.

    Attributes:
        smoothing: lambda, the weight of the newest value; small finds small drifts, slowly.
        false_alarm_checks: Mean number of trials between false alarms, where nothing changes.
        scatter_min: Standard deviation of the log cost that is always allowed for: a drift that is
            small beside it is of no interest, however quiet the rig.

    Raises:
        InvalidInput: a setting is out of its range.
    """

    smoothing: float = 0.2
    false_alarm_checks: float = 1000.0
    scatter_min: float = 0.01

    def __post_init__(self) -> None:
        if not 0.01 <= self.smoothing <= 1.0:
            raise InvalidInput(f"smoothing is {self.smoothing}; it must be from 0.01 to 1")
        if not 10.0 <= self.false_alarm_checks <= 1e6:
            raise InvalidInput(
                f"false_alarm_checks is {self.false_alarm_checks}; it must be from 10 to 1e6"
            )
        if not (math.isfinite(self.scatter_min) and self.scatter_min > 0.0):
            raise InvalidInput(f"scatter_min is {self.scatter_min}; it must be above zero")

    @property
    def limit(self) -> float:
        """The limit h."""
        return limit_for(self.smoothing, self.false_alarm_checks)

    @property
    def far(self) -> float:
        """|q| of a trial so far off that it is repeated: as rare as a false alarm."""
        from scipy.special import ndtri  # noqa: PLC0415  slow to import

        return -float(ndtri(0.5 / self.false_alarm_checks))

    def begin(self, costs: Sequence[float], *others: Sequence[float]) -> ChartState:
        """The chart before its first trial.

        Args:
            costs: Costs of repeats of the gains that are watched.
            others: Costs of repeats of other gains under the same noise, which tell of the
                scatter alone.

        Raises:
            InvalidInput: there are not two costs of the same gains, or one is not above zero.
        """
        groups = [_logarithms(group) for group in (costs, *others) if len(group) > 0]
        if not len(costs) or sum(len(group) - 1 for group in groups) < 1:
            raise InvalidInput("a control chart needs two repeats of the same gains to begin with")
        squares = sum(sum((x - np.mean(group)) ** 2 for x in group) for group in groups)
        freedom = sum(len(group) - 1 for group in groups)
        return ChartState(len(costs), float(np.mean(groups[0])), float(squares), freedom)

    def update(self, state: ChartState, cost: float) -> tuple[ChartState, ChartSignal]:
        """The chart after one more check trial, and what that says.

        Args:
            state: Where it stood.
            cost: The trial's cost; infinite where it was unsafe.

        Raises:
            InvalidInput: the cost is not above zero.
        """
        q = self.deviation(state, cost)
        if abs(q) > self.far:
            side = 1 if q > 0.0 else -1
            if state.suspect == side:  # two in a row are no accident
                return state, ChartSignal.WORSE if side > 0 else ChartSignal.BETTER
            return state._replace(suspect=side), ChartSignal.SUSPECT
        z = (1.0 - self.smoothing) * state.smoothed + self.smoothing * q
        # Whether to learn is decided by what came before: the value itself has no say in it.
        calm = abs(state.smoothed) <= CALM * self.limit
        learnt = _learn(state, math.log(cost)) if calm else state
        told = learnt._replace(smoothed=z, suspect=0)
        if abs(z) > self.limit:
            return told, ChartSignal.WORSE if z > 0.0 else ChartSignal.BETTER
        return told, ChartSignal.OUTLIER if state.suspect else ChartSignal.STEADY

    def deviation(self, state: ChartState, cost: float) -> float:
        """The q of a cost: how far off it is, in standard deviations.

        Raises:
            InvalidInput: the cost is not above zero.
        """
        if cost == math.inf:
            return math.inf
        (x,) = _logarithms([cost])
        t = (x - state.mean) / (self.scatter(state) * math.sqrt(1.0 + 1.0 / state.known))
        from scipy.special import ndtri, stdtr  # noqa: PLC0415  slow to import

        # The lower tail, where the distributions keep their digits.
        return math.copysign(float(ndtri(stdtr(state.freedom, -abs(t)))), t)

    def scatter(self, state: ChartState) -> float:
        """Standard deviation of the log cost that is reckoned with."""
        return max(math.sqrt(state.squares / state.freedom), self.scatter_min)


@lru_cache(maxsize=64)
def limit_for(smoothing: float, run_length: float) -> float:
    """The limit h that gives an average run length while nothing changes."""
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    def off(h: float) -> float:
        return math.log(average_run_length(smoothing, h) / run_length)

    sigma = math.sqrt(smoothing / (2.0 - smoothing))  # of z, after a long time
    return float(brentq(off, 0.5 * sigma, 6.0 * sigma, xtol=1e-9))


def average_run_length(smoothing: float, limit: float, shift: float = 0.0) -> float:
    """Mean number of values until |z| passes the limit.

    Args:
        smoothing: lambda.
        limit: h.
        shift: Mean of the q, their standard deviation being 1; 0 while nothing has changed.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    y, w = limit * nodes, limit * weights
    u = np.append(y, 0.0)
    normal = (y - (1.0 - smoothing) * u[:, None]) / smoothing - shift
    kernel = w * np.exp(-0.5 * normal**2) / (smoothing * math.sqrt(2.0 * math.pi))
    at_nodes = np.linalg.solve(np.eye(NODES) - kernel[:-1], np.ones(NODES))
    return float(1.0 + kernel[-1] @ at_nodes)


def _learn(state: ChartState, x: float) -> ChartState:
    """Takes a value into the baseline, so long as it is not known well enough."""
    if state.known >= LEARNT:
        return state
    known = state.known + 1
    mean = state.mean + (x - state.mean) / known
    squares = state.squares + (x - state.mean) * (x - mean)
    return state._replace(known=known, mean=mean, squares=squares, freedom=state.freedom + 1)


def _logarithms(costs: Sequence[float]) -> list[float]:
    for cost in costs:
        if not (math.isfinite(cost) and cost > 0.0):
            raise InvalidInput(f"cost {cost} cannot be charted; it must be finite and above zero")
    return [math.log(cost) for cost in costs]
