"""Statistical comparison of gains by repeated trials.

Repeats are interleaved, A B, B A, A B, so that a drift of the rig falls on all gains alike: over
every two rounds an even drift adds the same to each mean.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, variance
from typing import NamedTuple, Self

from estune.core.gains import Gains
from estune.errors import InvalidInput

EARLY_END = 0.6
"""Share of the error probability of an interval that is spent: the rest pays for repeats that end
once the interval is narrow, which happens most easily by a scatter that is small by chance. With
it 95 % intervals of such repeats hold the true change in at least 0.945 of runs at 18 pairs of
improvement and noise (`tests/test_comparison.py`); with all of it spent they do not."""


@dataclass(frozen=True, slots=True)
class Change:
    """Relative change of the cost; negative is a decrease.

    Attributes:
        estimate: Most likely value.
        low: Lower end of its confidence interval.
        high: Upper end; below zero if the cost decreased significantly.
    """

    estimate: float
    low: float
    high: float
    confidence: float

    @property
    def is_decrease(self) -> bool:
        """Whether the whole interval lies below zero."""
        return self.high < 0.0

    def __str__(self) -> str:
        return (
            f"{self.estimate:+.1%} ({self.confidence:.0%} interval "
            f"{self.low:+.1%} to {self.high:+.1%})"
        )


def interval_factor(degrees: float, level: float = 0.95) -> float:
    """Student's t: half the width of a confidence interval, in standard errors.

    Raises:
        InvalidInput: the level does not lie between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise InvalidInput(f"confidence level is {level}; it must lie between 0 and 1")
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    return float(stdtrit(degrees, 0.5 * (1.0 + level)))


def compare_costs(
    before: Sequence[float], after: Sequence[float], confidence: float = 0.95
) -> Change:
    """Compares two sets of repeats by their log costs: Welch's interval of unequal variances.

    With means m and variances v of n logarithms each, the difference of the means has the standard
    error sqrt(v1/n1 + v2/n2) and, by Welch and Satterthwaite, (v1/n1 + v2/n2)^2 /
    ((v1/n1)^2/(n1 - 1) + (v2/n2)^2/(n2 - 1)) degrees of freedom.

    Args:
        before: Costs of safe repeats.
        after: Costs of safe repeats of other gains.
        confidence: Of the interval, 0 to 1. It holds for gains chosen by other trials than these
            repeats: the best of several by the same repeats is biased.

    Raises:
        InvalidInput: there are fewer than two repeats of either, a cost is not above zero and
            finite, or the confidence is not between 0 and 1.
    """
    if min(len(before), len(after)) < 2:
        raise InvalidInput("two repeats of each of two gains are needed to compare them")
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence is {confidence}; it must lie between 0 and 1")
    if not all(0.0 < cost < math.inf for cost in (*before, *after)):
        raise InvalidInput(
            "a cost is not above zero, or not finite; only safe repeats can be compared"
        )
    old, new = ([math.log(cost) for cost in costs] for costs in (before, after))
    shares = [variance(logs) / len(logs) for logs in (old, new)]
    difference, error = fmean(new) - fmean(old), math.sqrt(sum(shares))
    if error == 0.0:
        change = math.expm1(difference)
        return Change(change, change, change, confidence)
    per_share = zip(shares, (old, new), strict=True)
    freedom = sum(shares) ** 2 / sum(share**2 / (len(logs) - 1) for share, logs in per_share)
    half_width = interval_factor(freedom, confidence) * error
    ends = (difference, difference - half_width, difference + half_width)
    estimate, low, high = map(math.expm1, ends)
    return Change(estimate, low, high, confidence)


def repeatability(groups: Iterable[Sequence[float]]) -> float:
    """Pooled standard deviation of the log cost between repeats; nan without any.

    Args:
        groups: Costs of repeats, one sequence per set of gains; infinite costs are left out.
    """
    squares, freedom = 0.0, 0
    for group in groups:
        logs = [math.log(cost) for cost in group if math.isfinite(cost)]
        if len(logs) > 1:
            mean = fmean(logs)
            squares += sum((log - mean) ** 2 for log in logs)
            freedom += len(logs) - 1
    return math.sqrt(squares / freedom) if freedom else math.nan


class InterleavedRepeats(NamedTuple):
    """Gains repeated in alternating order, and their costs so far.

    Gains with an unsafe repeat are not repeated again. With fewer than two left the comparison is
    over.

    Attributes:
        rounds: Repeats of each that are wanted.
        costs: Costs of each, in the order of the gains; infinite where a repeat was unsafe.
        ahead: Index of the gains that are next out of turn; None without any.
    """

    gains: tuple[Gains, ...]
    rounds: int
    costs: tuple[tuple[float, ...], ...]
    ahead: int | None = None

    @classmethod
    def new(cls, gains: tuple[Gains, ...], rounds: int, known: Sequence[float] = ()) -> Self:
        """The comparison before its first repeat, with known costs of the first gains."""
        return cls(gains, rounds, (tuple(known), *((),) * (len(gains) - 1)))

    @property
    def safe(self) -> tuple[int, ...]:
        """Indices of the gains without an unsafe repeat."""
        return tuple(i for i, costs in enumerate(self.costs) if math.inf not in costs)

    @property
    def next_index(self) -> int | None:
        """Index of the gains to run next; None when the repeats are over."""
        safe = self.safe
        if len(safe) < 2:
            return None
        if self.ahead is not None:
            return self.ahead
        done = min(len(self.costs[i]) for i in safe)
        if done >= self.rounds:
            return None
        order = safe if done % 2 == 0 else safe[::-1]
        return next(i for i in order if len(self.costs[i]) == done)

    @property
    def missing(self) -> int:
        """Number of repeats to come if all of them are safe."""
        if self.next_index is None:
            return 0
        return sum(max(self.rounds - len(self.costs[i]), 0) for i in self.safe)

    @property
    def best(self) -> int | None:
        """Index of the gains with the least mean cost; None if all were unsafe."""
        means = {i: fmean(self.costs[i]) if self.costs[i] else math.inf for i in self.safe}
        return min(means, key=means.__getitem__, default=None)

    def change(self, confidence: float = 0.95) -> Change:
        """Change of the cost from the first gains to the second, both safe.

        The interval holds for repeats that end as soon as it is narrow.
        """
        spent = 1.0 - EARLY_END * (1.0 - confidence)
        found = compare_costs(self.costs[0], self.costs[1], spent)
        return replace(found, confidence=confidence)

    def until(self, is_narrow: Callable[[Change], bool], least: int, most: int) -> Self:
        """The comparison of two gains over once its interval is narrow, else one round longer.

        Args:
            is_narrow: Whether the interval of a change is narrow enough.
            least: Repeats of each that there have to be.
            most: Repeats of each after which it is over in any case.
        """
        done = min(map(len, self.costs))
        if len(self.safe) < 2 or done < least:
            return self
        return self._replace(rounds=done if done >= most or is_narrow(self.change()) else done + 1)

    def with_cost(self, cost: float) -> Self:
        """The comparison with the cost of the gains run last; infinite if unsafe."""
        here = self.next_index
        costs = tuple((*c, cost) if i == here else c for i, c in enumerate(self.costs))
        return self._replace(costs=costs, ahead=None)
