"""What the trials of a run count up to, and which of them were unsafe."""

import math
from collections.abc import Iterable
from statistics import fmean
from typing import NamedTuple, Self

from estune.run.journal import JournalEntry
from estune.run.phase import Phase
from estune.trial import Outcome

UNSAFE_RATIO = 3.0
"""Default of the unsafe cost, as a multiple of the initial cost."""


class Tally(NamedTuple):
    """What the trials of a run count up to, whatever its tuner.

    Attributes:
        eta_max_given: The cost above which a trial is unsafe, where the plan gives one.
        number: Trials that count: all but void ones.
        baseline: Costs of the initial gains.
        best: Lowest cost of a safe trial of the initial gains or of the search, and its number;
            not of a repeat, which is of gains that were chosen for a low cost.
    """

    eta_max_given: float | None
    number: int = 0
    unsafe: int = 0
    declined: int = 0
    baseline: tuple[float, ...] = ()
    best: tuple[float, int] | None = None

    @property
    def start_cost(self) -> float | None:
        """Mean cost of the initial gains; None until there is one."""
        return fmean(self.baseline) if self.baseline else None

    @property
    def eta_max(self) -> float:
        """The cost above which a trial is unsafe; infinite until there is a baseline."""
        if self.eta_max_given is not None:
            return self.eta_max_given
        return math.inf if self.start_cost is None else UNSAFE_RATIO * self.start_cost

    def after(self, trials: Iterable[tuple[Phase, Outcome, float]]) -> Self:
        """The tally after further trials, each by its phase, outcome and cost."""
        number, unsafe, declined, baseline, best = self[1:]
        eta_max = self.eta_max  # once, and after each cost of the initial gains: runs are long
        for phase, outcome, cost in trials:
            if outcome is not Outcome.DONE and outcome.is_void:
                continue
            if is_unsafe(phase, outcome, cost, eta_max):
                unsafe += 1
            elif outcome is Outcome.DECLINED:
                declined += 1
            elif phase in (Phase.BASELINE, Phase.SEARCH):
                best = min(best or (math.inf, 0), (cost, number))
                if phase is Phase.BASELINE:
                    baseline = (*baseline, cost)
                    eta_max = self._replace(baseline=baseline).eta_max
            number += 1
        return type(self)(self.eta_max_given, number, unsafe, declined, baseline, best)


def is_safe(phase: Phase, outcome: Outcome, cost: float, eta_max: float) -> bool:
    """Whether the trial has a cost, of at most `eta_max`: the guard `eta < eta_max`.

    A cost that is not above zero is invalid: (35) is positive. An excitation has none.
    """
    if outcome is not Outcome.DONE or phase is Phase.EXCITE:
        return outcome is Outcome.DONE
    return 0.0 < cost <= eta_max and not math.isinf(cost)


def was_safe(entry: JournalEntry, eta_max: float) -> bool:
    """As `is_safe`, of a trial in the journal; one that is under way is not."""
    ended = entry.outcome
    return ended is not None and is_safe(entry.phase, ended, entry.cost, eta_max)


def was_unsafe(entry: JournalEntry, eta_max: float) -> bool:
    """As `is_unsafe`, of a trial in the journal; one that is under way is not."""
    ended = entry.outcome
    return ended is not None and is_unsafe(entry.phase, ended, entry.cost, eta_max)


def is_unsafe(phase: Phase, outcome: Outcome, cost: float, eta_max: float) -> bool:
    """Whether the trial was unsafe: it was run, and was not safe."""
    was_run = outcome is not Outcome.DECLINED and not outcome.is_void
    return was_run and not is_safe(phase, outcome, cost, eta_max)
