"""How much better gains are than others, the scatter of repeats counted."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, variance

from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class Change:
    """How much the cost changed, as a share of what it was; below zero is a fall.

    Attributes:
        estimate: Most likely value.
        low: Lower end of its confidence interval.
        high: Upper end; below zero where the cost fell beyond doubt.
        confidence: Of the interval.
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


def compare_costs(
    before: Sequence[float], after: Sequence[float], confidence: float = 0.95
) -> Change:
    """Compares two sets of repeats by their log costs: Welch's interval of unequal variances.

    With means m and variances v of n logarithms each, the difference of the means has the standard
    error sqrt(v1/n1 + v2/n2) and, by Welch and Satterthwaite, (v1/n1 + v2/n2)^2 /
    ((v1/n1)^2/(n1 - 1) + (v2/n2)^2/(n2 - 1)) degrees of freedom.

    Args:
        before: Costs of repeats, all of them safe.
        after: The same of other gains.
        confidence: Of the interval, 0 to 1. It holds for gains that were chosen by other trials
            than these: the best of several by their own repeats looks better than it is.

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
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    old, new = ([math.log(cost) for cost in costs] for costs in (before, after))
    shares = [variance(logs) / len(logs) for logs in (old, new)]
    difference, error = fmean(new) - fmean(old), math.sqrt(sum(shares))
    if error == 0.0:
        found = math.expm1(difference)
        return Change(found, found, found, confidence)
    per_share = zip(shares, (old, new), strict=True)
    freedom = sum(shares) ** 2 / sum(share**2 / (len(logs) - 1) for share, logs in per_share)
    reach = float(stdtrit(freedom, 0.5 * (1.0 + confidence))) * error
    ends = (difference, difference - reach, difference + reach)
    estimate, low, high = map(math.expm1, ends)
    return Change(estimate, low, high, confidence)


def repeatability(groups: Iterable[Sequence[float]]) -> float:
    """Standard deviation of the logarithm of the cost between repeats, pooled; nan without any.

    Args:
        groups: Costs of repeated trials, one sequence per set of gains; infinite ones do not
            count.
    """
    squares, freedom = 0.0, 0
    for group in groups:
        logs = [math.log(cost) for cost in group if math.isfinite(cost)]
        if len(logs) > 1:
            mean = fmean(logs)
            squares += sum((log - mean) ** 2 for log in logs)
            freedom += len(logs) - 1
    return math.sqrt(squares / freedom) if freedom else math.nan


def repeats_needed(
    expected: float, noise: float, *, least: int, most: int, confidence: float = 0.95
) -> int:
    """How many repeats of each of two gains tell their difference to a quarter of itself.

    The fewest n with t(2n - 2) noise sqrt(2/n) <= |expected|/4, t the quantile of the confidence.
    It must be asked before the repeats are made: were they gone on with until they look sharp
    enough, their interval would promise more than it holds.

    Args:
        expected: Difference of the logarithms of the costs that is likely.
        noise: Standard deviation of the logarithm of the cost between repeats; nan if unknown.
        least: No fewer than this, and no fewer than two.
        most: No more than this, unless `least` is more.
        confidence: Of the interval to be made, 0 to 1.
    """
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    n = max(2, least)
    while n < most:
        reach = float(stdtrit(2 * n - 2, 0.5 * (1.0 + confidence))) * noise * math.sqrt(2.0 / n)
        if reach <= 0.25 * abs(expected):  # not so for nan
            break
        n += 1
    return n
