"""What a rig can say to a command, in one word."""

from enum import StrEnum

from estune.remote.state_machine.trials import TrialState


class ReplyCode(StrEnum):
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
    ReplyCode.ACCEPTED: "done; a trial: taken in, and not begun",
    ReplyCode.RUNNING: "the trial was taken in before, has begun and has not ended",
    ReplyCode.ENDED: "the trial has ended; ask for its result",
    ReplyCode.NEVER_STARTED: "the rig was restarted before the trial began; nothing moved",
    ReplyCode.INTERRUPTED: "the rig was restarted in the middle of the trial",
    ReplyCode.VOID: "the trial was voided before it was taken in, and will never run",
    ReplyCode.UNKNOWN: "the ledger knows nothing of the trial",
    ReplyCode.BUSY: "a trial is under way",
    ReplyCode.HELD: "another client holds the lease",
    ReplyCode.NO_LEASE: "the command names a lease that is not, or is no longer, the rig's",
    ReplyCode.SAFE: "the rig is in its safe state after an emergency stop, until it is cleared",
    ReplyCode.REFUSED: "not done; the error says why",
}

OF_TRIAL = {
    TrialState.UNKNOWN: ReplyCode.UNKNOWN,
    TrialState.ACCEPTED: ReplyCode.ACCEPTED,
    TrialState.RUNNING: ReplyCode.RUNNING,
    TrialState.ENDED: ReplyCode.ENDED,
    TrialState.FAILED: ReplyCode.REFUSED,
    TrialState.NEVER_STARTED: ReplyCode.NEVER_STARTED,
    TrialState.INTERRUPTED: ReplyCode.INTERRUPTED,
    TrialState.VOID: ReplyCode.VOID,
}
"""How a rig says what its ledger knows of a trial."""
