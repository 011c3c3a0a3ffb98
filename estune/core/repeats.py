"""Repeats of two or more gains in turn, so that a drift of the rig falls on all of them alike.

The order turns with every round, A B, B A, A B: a cost that drifts evenly then adds the same to
the mean of each over every two rounds. Gains of which a repeat was unsafe are not repeated again,
and once fewer than two are left there is nothing more to compare.
"""

import math
from statistics import fmean
from typing import NamedTuple, Self

from estune.core.gains import Gains


class InterleavedRepeats(NamedTuple):
    """Gains that are repeated in turn, and what they cost so far.

    Attributes:
        gains: The gains, two or more.
        rounds: How often each is to be run.
        costs: Costs of each, in their order; infinite where a repeat was unsafe.
    """

    gains: tuple[Gains, ...]
    rounds: int
    costs: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, gains: tuple[Gains, ...], rounds: int) -> Self:
        """The same before the first repeat."""
        return cls(gains, rounds, ((),) * len(gains))

    @property
    def safe(self) -> tuple[int, ...]:
        """Places of the gains of which no repeat was unsafe."""
        return tuple(i for i, costs in enumerate(self.costs) if math.inf not in costs)

    @property
    def next_index(self) -> int | None:
        """Place of the gains to be run next; None when the repeats are over."""
        safe = self.safe
        if len(safe) < 2:
            return None
        done = min(len(self.costs[i]) for i in safe)
        if done >= self.rounds:
            return None
        order = safe if done % 2 == 0 else safe[::-1]
        return next(i for i in order if len(self.costs[i]) == done)

    @property
    def missing(self) -> int:
        """How many repeats are still to come if all of them are safe."""
        if self.next_index is None:
            return 0
        return sum(self.rounds - len(self.costs[i]) for i in self.safe)

    @property
    def best(self) -> int | None:
        """Place of the gains with the least mean cost; None where all have been unsafe."""
        means = {i: fmean(self.costs[i]) if self.costs[i] else math.inf for i in self.safe}
        return min(means, key=means.__getitem__, default=None)

    def with_cost(self, cost: float) -> Self:
        """The same with the cost of the gains whose turn it was; infinite if it was unsafe."""
        here = self.next_index
        costs = tuple((*c, cost) if i == here else c for i, c in enumerate(self.costs))
        return self._replace(costs=costs)
