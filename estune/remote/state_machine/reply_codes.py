"""What a rig can say to a command, in one word."""

from enum import StrEnum

from estune.remote.state_machine.trials import TrialState


class Verdict(StrEnum):
    """One word of an answer. Only the first is a yes."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    ENDED = "ended"
    NEVER_STARTED = "never_started"
    INTERRUPTED = "interrupted"
    VOID = "void"
    UNKNOWN = "unknown"
    BUSY = "busy"
    HELD = "held"
    NO_LEASE = "no_lease"
    SAFE = "safe"
    REFUSED = "refused"

    @property
    def sentence(self) -> str:
        """What it means."""
        return _SENTENCES[self]


_SENTENCES = {
    Verdict.ACCEPTED: "done; a trial: taken in, and not begun",
    Verdict.RUNNING: "the trial was taken in before, has begun and has not ended",
    Verdict.ENDED: "the trial has ended; ask for its result",
    Verdict.NEVER_STARTED: "the rig was restarted before the trial began; nothing moved",
    Verdict.INTERRUPTED: "the rig was restarted in the middle of the trial",
    Verdict.VOID: "the trial was voided before it was taken in, and will never run",
    Verdict.UNKNOWN: "the ledger knows nothing of the trial",
    Verdict.BUSY: "a trial is under way",
    Verdict.HELD: "another client holds the lease",
    Verdict.NO_LEASE: "the command names a lease that is not, or is no longer, the rig's",
    Verdict.SAFE: "the rig is in its safe state after an emergency stop, until it is cleared",
    Verdict.REFUSED: "not done; the error says why",
}

OF_TRIAL = {
    TrialState.UNKNOWN: Verdict.UNKNOWN,
    TrialState.ACCEPTED: Verdict.ACCEPTED,
    TrialState.RUNNING: Verdict.RUNNING,
    TrialState.ENDED: Verdict.ENDED,
    TrialState.FAILED: Verdict.REFUSED,
    TrialState.NEVER_STARTED: Verdict.NEVER_STARTED,
    TrialState.INTERRUPTED: Verdict.INTERRUPTED,
    TrialState.VOID: Verdict.VOID,
}
"""How a rig says what its ledger knows of a trial."""
