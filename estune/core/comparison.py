"""Whether gains are better than others beyond the scatter of repeats."""

import math
from collections.abc import Sequence
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
    def is_fall(self) -> bool:
        """Whether the whole interval lies below zero."""
        return self.high < 0.0

    def __str__(self) -> str:
        return (
            f"cost {self.estimate:+.1%}, {self.confidence:.0%} interval "
            f"{self.low:+.1%} to {self.high:+.1%}"
        )


def change(
    before: Sequence[float], after: Sequence[float], confidence: float = 0.95, choices: int = 1
) -> Change:
    """Compares two sets of repeats by their log costs: Welch's interval of unequal variances.

    With means m and variances v of n logarithms each, the difference of the means has the standard
    error sqrt(v1/n1 + v2/n2) and, by Welch and Satterthwaite, (v1/n1 + v2/n2)^2 /
    ((v1/n1)^2/(n1 - 1) + (v2/n2)^2/(n2 - 1)) degrees of freedom.

    Args:
        before: Costs of repeats; infinite where one was unsafe.
        after: The same of other gains.
        confidence: Of the interval, 0 to 1.
        choices: How many gains `after` is the best of: the interval is widened accordingly
            (Bonferroni), for the best of several looks better than it is.

    Raises:
        InvalidInput: there are fewer than two repeats of either, a cost is not above zero, or the
            confidence is not between 0 and 1.
    """
    if min(len(before), len(after)) < 2:
        raise InvalidInput("two repeats of each of two gains are needed to compare them")
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence is {confidence}; it must lie between 0 and 1")
    if not all(cost > 0.0 for cost in (*before, *after)):
        raise InvalidInput("a cost is not above zero; its logarithm cannot be compared")
    if math.inf in after:
        return Change(math.inf, -1.0, math.inf, confidence)
    if math.inf in before:
        return Change(-1.0, -1.0, -1.0, confidence)
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    old, new = ([math.log(cost) for cost in costs] for costs in (before, after))
    shares = [variance(logs) / len(logs) for logs in (old, new)]
    difference, error = fmean(new) - fmean(old), math.sqrt(sum(shares))
    if error == 0.0:
        found = math.expm1(difference)
        return Change(found, found, found, confidence)
    per_share = zip(shares, (old, new), strict=True)
    freedom = sum(shares) ** 2 / sum(share**2 / (len(logs) - 1) for share, logs in per_share)
    reach = float(stdtrit(freedom, 1.0 - 0.5 * (1.0 - confidence) / choices)) * error
    ends = (difference, difference - reach, difference + reach)
    estimate, low, high = map(math.expm1, ends)
    return Change(estimate, low, high, confidence)
