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
    """

    eta_max_given: float | None
    number: int = 0
    unsafe: int = 0
    declined: int = 0
    baseline: tuple[float, ...] = ()

    @property
    def eta_max(self) -> float:
        """The cost above which a trial is unsafe; infinite until there is a baseline."""
        if self.eta_max_given is not None:
            return self.eta_max_given
        return UNSAFE_RATIO * fmean(self.baseline) if self.baseline else math.inf

    def after(self, trials: Iterable[tuple[Phase, Outcome, float]]) -> Self:
        """The tally after further trials, each by its phase, outcome and cost."""
        number, unsafe, declined, baseline = self[1:]
        eta_max = self.eta_max  # once, and after each cost of the initial gains: runs are long
        for phase, outcome, cost in trials:
            if outcome is not Outcome.DONE and outcome.is_void:
                continue
            number += 1
            declined += outcome is Outcome.DECLINED
            if is_unsafe(phase, outcome, cost, eta_max):
                unsafe += 1
            elif phase is Phase.BASELINE and outcome is Outcome.DONE:
                baseline = (*baseline, cost)
                eta_max = self._replace(baseline=baseline).eta_max
        return self._replace(number=number, unsafe=unsafe, declined=declined, baseline=baseline)


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
