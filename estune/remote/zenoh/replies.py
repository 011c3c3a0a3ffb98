"""The words in which an attendant answers: what the ledger knows, what the rig raised."""

import logging
from datetime import UTC, datetime

from estune.errors import EstuneError, RigError
from estune.remote.ledger import LedgerEntry
from estune.remote.messages import Answer, refusal
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.trials import TrialState
from estune.trial import Outcome, RigDescription, TrialRecord, TrialRequest, empty_record

_log = logging.getLogger(__name__)


def to_estune_error(error: BaseException, doing: str) -> EstuneError:
    """An error of the tree for whatever a rig has raised; the trace of a stranger is logged."""
    if isinstance(error, EstuneError):
        return error
    _log.error("the rig failed in %s", doing, exc_info=error)
    return RigError(
        f"the rig's own program failed in {doing}: {type(error).__name__}: {error}; "
        "the trace is in its log"
    )


def never_begun(request: TrialRequest, rig: RigDescription) -> TrialRecord:
    """The record of a trial that was stopped before it began."""
    at = datetime.now(UTC).isoformat(timespec="milliseconds")
    return empty_record(request, rig, Outcome.CANCELLED, "stopped before it began", at)


def reply_from_ledger(trial_id: str, entry: LedgerEntry) -> Answer | bytes:
    """What the ledger knows of a trial: its record, if it holds it."""
    match entry.state:
        case TrialState.ENDED if entry.frame is not None:
            return entry.frame
        case TrialState.ENDED:
            return refusal(
                RigError(
                    f"trial {trial_id} has run, but the rig no longer holds its record; "
                    "ask for the trial again under another number or attempt"
                ),
                trial_id,
            )
        case TrialState.FAILED:
            return Answer(ReplyCode.REFUSED, trial_id, entry.error, entry.sentence)
        case state:
            return Answer(OF_TRIAL[state], trial_id)


def has_digest_conflict(entry: LedgerEntry, digest: str) -> bool:
    """Whether the ledger knows another request under the id."""
    return entry.state is not TrialState.UNKNOWN and entry.digest != digest


def digest_conflict_reply(trial_id: str) -> Answer:
    """The answer to a request under the id of another."""
    return refusal(
        RigError(
            f"the rig knows another trial by the id {trial_id}, with other gains or another "
            "profile; give the run a new name"
        ),
        trial_id,
    )
