"""Executed trial ids and recent records of a rig that runs trials in its own process."""

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator

from estune.errors import RigError
from estune.trial.records import TrialRecord, TrialRequest

RECORDS_MAX = 64
"""Number of stored records; of older trials only the ids are stored."""

STOP_INTERVAL_S = 0.02
"""Interval at which the stop of a trial is repeated, s."""


class ExecutedTrials:
    """The latest records and the ids of all trials, so that none runs twice.

    Args:
        same_anew: Whether a repeated trial gives the same record, as on a simulated rig; it may
            then run again once its record is dropped.
    """

    def __init__(self, *, same_anew: bool = False) -> None:
        self._same_anew = same_anew
        self._records: OrderedDict[str, tuple[TrialRequest, TrialRecord]] = OrderedDict()
        self._ids: set[str] = set()

    def add(self, request: TrialRequest, record: TrialRecord) -> None:
        """Stores a record."""
        if not self._same_anew:
            self._ids.add(request.trial_id)
        self._records[request.trial_id] = request, record
        if len(self._records) > RECORDS_MAX:
            self._records.popitem(last=False)

    def find_record(self, request: TrialRequest) -> TrialRecord | None:
        """The record of a trial that has run before; None if it may run.

        Raises:
            RigError: another trial had the id, or its record is dropped.
        """
        if request.trial_id in self._records:
            earlier, record = self._records[request.trial_id]
            if request != earlier:
                raise RigError(
                    f"trial {request.trial_id} has run with other gains or another profile; "
                    "a trial id is used once: use a new run name or attempt"
                )
            return record
        if request.trial_id in self._ids:
            raise RigError(
                f"trial {request.trial_id} has run, but the rig no longer holds its record; "
                "use another number or attempt"
            )
        return None


@contextlib.contextmanager
def stopped_trial(trial: threading.Lock, stop: Callable[[], None]) -> Iterator[None]:
    """Stops the running trial and holds its lock `trial` for the duration of the block."""
    acquired = False
    while not acquired:
        stop()  # repeated, because a trial that is just beginning may miss it
        acquired = trial.acquire(timeout=STOP_INTERVAL_S)
    try:
        yield
    finally:
        trial.release()
