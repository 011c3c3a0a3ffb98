"""The level of a reel: its mean cost over repeats, and how surely it is known."""

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import NamedTuple

CONFIDENCE = 0.95


class CostEstimate(NamedTuple):
    """The cost of some gains on one reel.

    Attributes:
        cost: Mean cost over the repeats, of their logarithms; infinite where one was unsafe.
        low: Lower end of its 95 % interval, Student's t on the logarithms.
        high: Upper end.
        repeats: How many there were.
    """

    cost: float
    low: float
    high: float
    repeats: int

    @property
    def half_width(self) -> float:
        """Half the width of the interval, relative to the cost."""
        return 0.5 * (self.high - self.low) / self.cost

    def __str__(self) -> str:
        return f"{self.cost:.4g} ({self.low:.4g} to {self.high:.4g})"


def level_of(costs: Sequence[float]) -> CostEstimate:
    """The level by repeats; one alone, or one that was unsafe, leaves it open upward.

    Args:
        costs: Costs of repeats, at least one; not finite where a trial was unsafe.
    """
    n = len(costs)
    if not all(map(math.isfinite, costs)):
        return CostEstimate(math.inf, 0.0, math.inf, n)
    logs = [math.log(cost) for cost in costs]
    mean = fmean(logs)
    if n < 2:
        return CostEstimate(math.exp(mean), 0.0, math.inf, n)
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    reach = float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE)) * stdev(logs) / math.sqrt(n)
    return CostEstimate(math.exp(mean), math.exp(mean - reach), math.exp(mean + reach), n)
