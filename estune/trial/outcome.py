"""The ends of a trial."""

from estune.core.sentence_enum import SentenceEnum


class Outcome(SentenceEnum):
    """End of a trial. Only `done` has a cost; void trials carry no information on the gains."""

    DONE = "done", "the trial ran to its end"
    DIVERGED = "diverged", "the response left the finite range"
    GUARD = "guard", "the rig's guard ended the trial at one of its limits"
    CANCELLED = "cancelled", "the trial was stopped by the operator"
    INTERRUPTED = "interrupted", "the rig stopped in the middle of the trial"
    DECLINED = "declined", "the operator declined the trial"

    @property
    def is_void(self) -> bool:
        """Whether the trial carries no information on its gains and may be repeated."""
        return self in (Outcome.CANCELLED, Outcome.INTERRUPTED)
