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


class TrialNotes(Protocol):
    """What outlives the process that asks for trials: a run's journal, a daemon's store."""

    submitted: SubmittedTrial | None


@runtime_checkable
class LedgerKeeper(Protocol):
    """A rig that keeps a ledger of the trials that have run."""

    @property
    def ledger(self) -> str:
        """Identity of the ledger."""
        ...


def lost_trial(notes: TrialNotes, trial_id: str, ledger: str) -> str:
    """Why a trial must not run before an operator has looked at the rig; empty if it may.

    A ledger answers only for the trials that it has noted: to another one, the trial under way is
    a new one, and would run a second time.
    """
    then = notes.submitted
    # An end is noted before the record is stored: after a crash between, the id is asked again.
    if then is None or then.ledger == ledger or (then.ended and then.trial_id != trial_id):
        return ""
    return (
        f"the rig came back with another ledger, {ledger} instead of {then.ledger}, which does "
        f"not know whether trial {then.trial_id} has run"
    )
