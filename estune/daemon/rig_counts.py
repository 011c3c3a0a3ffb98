"""Counts of one rig since its daemon was started, for the metrics."""

from collections import Counter
from dataclasses import dataclass, field

from estune.trial import Outcome


@dataclass(slots=True)
class RigCounts:
    """Counts of one rig.

    Attributes:
        trials: Trials by outcome; those that no record could be had of are not among them.
        trial_s: Time of these trials together, from the request to the record.
        leases_lost: Leases that ended during a trial.
        commands_refused: Commands of operators that the mode did not allow.
    """

    trials: Counter[str] = field(default_factory=Counter)
    trial_s: float = 0.0
    leases_lost: int = 0
    commands_refused: int = 0
    faults: Counter[str] = field(default_factory=Counter)

    def note_trial(self, outcome: Outcome, took_s: float) -> None:
        """Counts a trial."""
        self.trials[outcome.value] += 1
        self.trial_s += took_s
