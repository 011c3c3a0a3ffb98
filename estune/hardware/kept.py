"""The records a rig on hardware keeps, so that a trial asked for again does not run again."""

from collections import OrderedDict

from estune.errors import RigError
from estune.trial import TrialRecord, TrialRequest

REMEMBERED = 64
"""Records kept for a trial that is asked for again; of older ones only the ids are."""


class Kept:
    """The youngest records, and the ids of all trials."""

    def __init__(self) -> None:
        self._records: OrderedDict[str, tuple[TrialRequest, TrialRecord]] = OrderedDict()
        self._ids: set[str] = set()

    def add(self, request: TrialRequest, record: TrialRecord) -> None:
        """Keeps a record."""
        self._ids.add(request.trial_id)
        self._records[request.trial_id] = request, record
        if len(self._records) > REMEMBERED:
            self._records.popitem(last=False)

    def again(self, request: TrialRequest) -> TrialRecord | None:
        """The record of a trial that has run before; None if it has not.

        Raises:
            RigError: another trial had the id, or its record is kept no longer.
        """
        if request.trial_id not in self._ids:
            return None
        if request.trial_id not in self._records:
            raise RigError(
                f"trial {request.trial_id} has run, but the rig no longer holds its record; "
                "ask under another number or attempt"
            )
        asked, record = self._records[request.trial_id]
        if request != asked:
            raise RigError(
                f"trial {request.trial_id} has run with other gains or another profile; "
                "a trial id is used once: ask under a new run name or attempt"
            )
        return record
