"""Trials that a rig refuses, cannot run under their id again, or must not."""

import contextlib
import logging
from datetime import UTC, datetime
from typing import Protocol, runtime_checkable

from estune.errors import EstuneError, Interrupted, InvalidInput
from estune.run.submitted_trial import LedgerKeeper, SubmittedTrial, TrialNotes
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest, empty_record

_log = logging.getLogger(__name__)


@runtime_checkable
class FailureMemory(Protocol):
    """A rig that remembers which trials have failed in its own program."""

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether no record can ever be had under a trial's id."""
        ...


def run_trial(
    rig: Rig,
    request: TrialRequest,
    description: RigDescription,
    *,
    notes: TrialNotes | None = None,
    may_be_refused: bool = False,
) -> TrialRecord:
    """The record of a trial; a void one where none can ever be had under its id.

    A rig does not run an id twice, so that a trial which failed there, before it began or in it,
    would fail for ever. On a rig that moves it counts as interrupted, and so does one of which no
    ledger can say whether it has run. One that may be refused, as of a profile that not every rig
    runs, counts as declined.

    Args:
        rig: The rig.
        request: The trial.
        description: The rig's description.
        notes: Where the trial is noted, if it may have to be asked for again by a later process.
        may_be_refused: Whether the rig may refuse it.

    Raises:
        EstuneError: the rig cannot be reached, or refuses.
        JournalError: the trial cannot be noted.
    """
    if notes is None or description.simulated or not isinstance(rig, LedgerKeeper):
        return _run_trial(rig, request, description, may_be_refused=may_be_refused)
    ledger, last = rig.ledger, notes.submitted
    if last is not None and (doubt := last.doubt(request.trial_id, ledger)):
        # Under its old ledger: until the caller has stored this record, the id stays barred.
        notes.submitted = SubmittedTrial(request.trial_id, last.ledger, ended=True)
        return _interrupted(request, description, doubt)
    notes.submitted = SubmittedTrial(request.trial_id, ledger, ended=False)
    record = _run_trial(rig, request, description, may_be_refused=may_be_refused)
    notes.submitted = SubmittedTrial(request.trial_id, ledger, ended=True)
    return record


def needs_operator(record: TrialRecord, description: RigDescription) -> bool:
    """Whether an operator has to look at the rig after a trial before anything moves again."""
    # After a fault nobody knows how the machine stands; a late computer is none of its faults.
    interrupted = record.outcome is Outcome.INTERRUPTED and not record.ended_late
    return interrupted and not description.simulated


def cut_off(record: TrialRecord) -> str:
    """What an operator is told of an interrupted trial: a reason that names it says the rest."""
    if record.trial_id in record.reason:
        return record.reason
    why = record.reason or record.outcome.sentence
    return f"trial {record.trial_id} on rig {record.rig} was interrupted ({why})"


def _run_trial(
    rig: Rig, request: TrialRequest, description: RigDescription, *, may_be_refused: bool
) -> TrialRecord:
    try:
        return rig.run(request)
    except Interrupted as error:
        return _interrupted(request, description, error.what)
    except EstuneError as error:
        if may_be_refused and isinstance(error, InvalidInput):
            return declined(request, description, f"the rig refused it: {error}")
        if not _has_failed(rig, request):
            raise
        if description.simulated:
            _log.error("%s", error, extra={"rig": description.name})
            return empty_record(request, description, Outcome.CANCELLED, str(error), _now())
        return _interrupted(request, description, str(error))


def _interrupted(request: TrialRequest, description: RigDescription, reason: str) -> TrialRecord:
    return empty_record(request, description, Outcome.INTERRUPTED, reason, _now())


def declined(request: TrialRequest, description: RigDescription, reason: str = "") -> TrialRecord:
    """The record of a trial that was not run."""
    outcome = Outcome.DECLINED
    return empty_record(request, description, outcome, reason or outcome.sentence, _now())


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _has_failed(rig: Rig, request: TrialRequest) -> bool:
    if isinstance(rig, FailureMemory):
        with contextlib.suppress(EstuneError):  # unreachable: known after reconnection
            return rig.has_failed(request)
    return False
