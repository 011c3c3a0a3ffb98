"""Reply codes of a rig."""

from estune.core.sentence_enum import SentenceEnum
from estune.remote.state_machine.trials import TrialState


class ReplyCode(SentenceEnum):
    """Result of a command in one word; only `accepted` is a success of every command."""

    ACCEPTED = "accepted", "done; of a trial: accepted, not yet started"
    RUNNING = "running", "the trial was accepted before, has started and has not ended"
    ENDED = "ended", "the trial has ended; query its result"
    NEVER_STARTED = (
        "never_started",
        "the rig was restarted before the trial started; nothing moved",
    )
    INTERRUPTED = "interrupted", "the rig was restarted in the middle of the trial"
    VOID = "void", "the trial was voided before it was accepted, and will never run"
    UNKNOWN = "unknown", "the ledger holds no entry of the trial"
    BUSY = "busy", "a trial is active"
    HELD = "held", "another client holds the lease"
    NO_LEASE = "no_lease", "the lease in the command is not, or no longer, the rig's"
    SAFE = "safe", "the rig is in its safe state after an emergency stop, until it is cleared"
    REFUSED = "refused", "not done; the error gives the reason"


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
