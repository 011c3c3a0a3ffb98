"""Reply codes of a rig."""

from enum import StrEnum

from estune.remote.state_machine.trials import TrialState


class ReplyCode(StrEnum):
    """Result of a command in one word; only `accepted` is a success of every command."""

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
        """Meaning of the code."""
        return _SENTENCES[self]


_SENTENCES = {
    ReplyCode.ACCEPTED: "done; of a trial: accepted, not yet started",
    ReplyCode.RUNNING: "the trial was accepted before, has started and has not ended",
    ReplyCode.ENDED: "the trial has ended; query its result",
    ReplyCode.NEVER_STARTED: "the rig was restarted before the trial started; nothing moved",
    ReplyCode.INTERRUPTED: "the rig was restarted in the middle of the trial",
    ReplyCode.VOID: "the trial was voided before it was accepted, and will never run",
    ReplyCode.UNKNOWN: "the ledger holds no entry of the trial",
    ReplyCode.BUSY: "a trial is active",
    ReplyCode.HELD: "another client holds the lease",
    ReplyCode.NO_LEASE: "the lease in the command is not, or no longer, the rig's",
    ReplyCode.SAFE: "the rig is in its safe state after an emergency stop, until it is cleared",
    ReplyCode.REFUSED: "not done; the error gives the reason",
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
"""Reply code by state of the trial in the ledger."""
