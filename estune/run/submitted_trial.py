"""The trial last submitted to a rig, as noted by whoever may have to ask for it again."""

from typing import NamedTuple, Protocol, runtime_checkable


class SubmittedTrial(NamedTuple):
    """The trial last submitted to a rig that moves.

    Attributes:
        ledger: Identity of the ledger that noted it.
        ended: Whether its end is known, here as well.
    """

    trial_id: str
    ledger: str
    ended: bool

    def doubt(self, trial_id: str, ledger: str) -> str:
        """Why a trial must not run before an operator has looked at the rig; empty if it may.

        A ledger answers only for the trials that it has noted: to another one, the trial under way
        is a new one, and would run a second time.
        """
        # An end is noted before its record is stored: a crash between has it asked for again.
        if ledger == self.ledger or (self.ended and trial_id != self.trial_id):
            return ""
        return (
            f"the rig came back with another ledger, {ledger} instead of {self.ledger}, which "
            f"does not know whether trial {self.trial_id} has run"
        )


class TrialNotes(Protocol):
    """What outlives whoever asks: a journal, a daemon's store, an improvement's folder."""

    submitted: SubmittedTrial | None


@runtime_checkable
class LedgerKeeper(Protocol):
    """A rig that keeps a ledger of the trials that have run."""

    @property
    def ledger(self) -> str:
        """Identity of the ledger."""
        ...
