"""Trials that a rig refuses, or cannot run under their id again."""

import contextlib
import logging
from datetime import UTC, datetime
from typing import Protocol, runtime_checkable

from estune.errors import EstuneError, InvalidInput
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest, empty_record

_log = logging.getLogger(__name__)


@runtime_checkable
class FailureMemory(Protocol):
    """A rig that remembers which trials have failed in its own program."""

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether no record can ever be had under a trial's id."""
        ...


def run_trial(
    rig: Rig, request: TrialRequest, description: RigDescription, *, may_be_refused: bool = False
) -> TrialRecord:
    """The record of a trial; a void one where none can ever be had under its id.

    A rig does not run an id twice, so that a trial which failed there, before it began or in it,
    would fail for ever. On a rig that moves it counts as interrupted. One that may be refused, as
    of a profile that not every rig runs, counts as declined.

    Raises:
        EstuneError: the rig cannot be reached, or refuses.
    """
    try:
        return rig.run(request)
    except EstuneError as error:
        if may_be_refused and isinstance(error, InvalidInput):
            return declined(request, description, f"the rig refused it: {error}")
        if not _has_failed(rig, request):
            raise
        _log.error("%s", error, extra={"rig": description.name})
        outcome = Outcome.CANCELLED if description.simulated else Outcome.INTERRUPTED
        return empty_record(request, description, outcome, str(error), _now())


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
