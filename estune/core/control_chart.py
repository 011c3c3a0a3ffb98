"""Control chart of the cost of check trials: separates drift from noise and from outliers.

The chart is of the log cost, because the standard deviation of the cost is proportional to it.
Each new value x_n is first transformed to a standard normal one (Quesenberry 1991),

    q_n = Phi^-1( F_t( (x_n - mean) / (s sqrt(1 + 1/n)) ; nu ) ),

with mean and s of the values before it and nu degrees of freedom of s. Without a change the q_n
are independent and exactly normal however few values came before, so that the rate of false alarms
does not depend on a short baseline. They are smoothed,

    z_n = (1 - lambda) z_(n-1) + lambda q_n,    z_0 = 0,    alarm where |z_n| > h,

an exponentially weighted moving average (Roberts 1959). The limit h follows from the mean number
of trials between false alarms, the average run length L(0), with (Crowder 1987)

    L(u) = 1 + 1/lambda int_-h^h L(y) phi((y - (1 - lambda) u) / lambda) dy.

The baseline continues to learn only while z is near zero, so that it does not follow a drift;
false alarms become slightly rarer by this. A drift can still enter a baseline of few values: run a
dozen or two check trials before there is time for one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.quantities import check_positive
from estune.core.sentence_enum import SentenceEnum
from estune.errors import InvalidInput

BASELINE_MAX = 100
"""Number of values after which the baseline is fixed."""

LEARN_BELOW = 0.3
"""The baseline learns only while |z| is within this share of its limit."""

NODES = 64
"""Points of the Gauss-Legendre rule; they give the run length to more than six digits."""


class ChartSignal(SentenceEnum):
    """Conclusion from the newest trial and those before it."""

    STEADY = "steady", "the cost is unchanged"
    SUSPECT = "suspect", "the cost is an outlier; the trial is repeated"
    OUTLIER = "outlier", "the trial before was a single outlier and does not count"
    WORSE = "worse", "the cost has increased significantly"
    BETTER = "better", "the cost has decreased significantly"


class ChartState(NamedTuple):
    """The state of a chart; stored by field name and position.

    Attributes:
        squares: Sum of squared deviations from the means.
        smoothed: z.
        suspect: -1 or 1 if the trial before was an outlier, below or above; else 0.
    """

    known: int
    mean: float
    squares: float
    freedom: int
    smoothed: float = 0.0
    suspect: int = 0


@dataclass(frozen=True, slots=True)
class ControlChart:
    """The settings of a chart; `begin` and `update` give its state.

    Attributes:
        smoothing: lambda, the weight of the newest value; small values find small drifts, slowly.
        false_alarm_checks: Mean number of trials between false alarms.
        scatter_min: Lower bound of the standard deviation of the log cost; a smaller drift does
            not matter, however quiet the rig.

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
        check_positive("scatter_min", self.scatter_min)

    @property
    def limit(self) -> float:
        """The limit h."""
        return limit_for(self.smoothing, self.false_alarm_checks)

    @property
    def outlier_limit(self) -> float:
        """|q| beyond which a trial is repeated; as rare as a false alarm."""
        from scipy.special import ndtri  # noqa: PLC0415  slow to import

        return -float(ndtri(0.5 / self.false_alarm_checks))

    def begin(self, costs: Sequence[float], *others: Sequence[float]) -> ChartState:
        """The chart before its first trial.

        Args:
            costs: Costs of repeats of the monitored gains.
            others: Costs of repeats of other gains under the same noise; they only add to the
                standard deviation.

        Raises:
            InvalidInput: no gains have two costs, or a cost is not above zero.
        """
        groups = [_logarithms(group) for group in (costs, *others) if len(group) > 0]
        if not len(costs) or sum(len(group) - 1 for group in groups) < 1:
            raise InvalidInput("a control chart needs two repeats of the same gains to begin with")
        squares = sum(sum((x - np.mean(group)) ** 2 for x in group) for group in groups)
        freedom = sum(len(group) - 1 for group in groups)
        return ChartState(len(costs), float(np.mean(groups[0])), float(squares), freedom)

    def update(self, state: ChartState, cost: float) -> tuple[ChartState, ChartSignal]:
        """The chart after one more check trial, and its signal.

        Args:
            state: Before the trial.
            cost: The trial's cost; infinite if unsafe.

        Raises:
            InvalidInput: the cost is not above zero.
        """
        q = self.deviation(state, cost)
        if abs(q) > self.outlier_limit:
            side = 1 if q > 0.0 else -1
            if state.suspect == side:  # the second in a row
                return state, ChartSignal.WORSE if side > 0 else ChartSignal.BETTER
            return state._replace(suspect=side), ChartSignal.SUSPECT
        z = (1.0 - self.smoothing) * state.smoothed + self.smoothing * q
        # Learning depends on earlier values alone, or the baseline would be biased.
        is_steady = abs(state.smoothed) <= LEARN_BELOW * self.limit
        baseline = _learn(state, math.log(cost)) if is_steady else state
        following = baseline._replace(smoothed=z, suspect=0)
        if abs(z) > self.limit:
            return following, ChartSignal.WORSE if z > 0.0 else ChartSignal.BETTER
        return following, ChartSignal.OUTLIER if state.suspect else ChartSignal.STEADY

    def deviation(self, state: ChartState, cost: float) -> float:
        """The deviation q of a cost, in standard deviations.

        Raises:
            InvalidInput: the cost is not above zero.
        """
        if cost == math.inf:
            return math.inf
        (x,) = _logarithms([cost])
        t = (x - state.mean) / (self.repeatability(state) * math.sqrt(1.0 + 1.0 / state.known))
        from scipy.special import ndtri, stdtr  # noqa: PLC0415  slow to import

        # The lower tail, where the distributions keep their digits.
        return math.copysign(float(ndtri(stdtr(state.freedom, -abs(t)))), t)

    def repeatability(self, state: ChartState) -> float:
        """Standard deviation of the log cost, at least `scatter_min`."""
        return max(math.sqrt(state.squares / state.freedom), self.scatter_min)


@lru_cache(maxsize=64)
def limit_for(smoothing: float, run_length: float) -> float:
    """The limit h that gives an average run length without a change."""
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    def log_error(h: float) -> float:
        return math.log(average_run_length(smoothing, h) / run_length)

    sigma = math.sqrt(smoothing / (2.0 - smoothing))  # of z, after a long time
    return float(brentq(log_error, 0.5 * sigma, 6.0 * sigma, xtol=1e-9))


def average_run_length(smoothing: float, limit: float, shift: float = 0.0) -> float:
    """Mean number of values until |z| passes the limit.

    Args:
        smoothing: lambda.
        limit: h.
        shift: Mean of the q, whose standard deviation is 1; 0 without a change.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    y, w = limit * nodes, limit * weights
    u = np.append(y, 0.0)
    normal = (y - (1.0 - smoothing) * u[:, None]) / smoothing - shift
    kernel = w * np.exp(-0.5 * normal**2) / (smoothing * math.sqrt(2.0 * math.pi))
    at_nodes = np.linalg.solve(np.eye(NODES) - kernel[:-1], np.ones(NODES))
    return float(1.0 + kernel[-1] @ at_nodes)


def _learn(state: ChartState, x: float) -> ChartState:
    if state.known >= BASELINE_MAX:
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
