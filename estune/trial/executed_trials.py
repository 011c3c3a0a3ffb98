"""A trial is a guest on its rig: what rigs that run trials in their own process share."""

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator

from estune.errors import RigError
from estune.trial.records import TrialRecord, TrialRequest

REMEMBERED = 64
"""Records kept for a trial that is asked for again; of older ones only the ids are."""

STOP_AGAIN_S = 0.02
"""How often a trial that is to stop is told so."""


class ExecutedTrials:
    """The youngest records, and the ids of all trials, so that none runs twice.

    Args:
        same_anew: Whether a trial that runs again gives the same record, as a simulated one does;
            it then may, once its record is kept no longer.
    """

    def __init__(self, *, same_anew: bool = False) -> None:
        self._same_anew = same_anew
        self._records: OrderedDict[str, tuple[TrialRequest, TrialRecord]] = OrderedDict()
        self._ids: set[str] = set()

    def add(self, request: TrialRequest, record: TrialRecord) -> None:
        """Keeps a record."""
        if not self._same_anew:
            self._ids.add(request.trial_id)
        self._records[request.trial_id] = request, record
        if len(self._records) > REMEMBERED:
            self._records.popitem(last=False)

    def find_record(self, request: TrialRequest) -> TrialRecord | None:
        """The record of a trial that has run before; None if it is to run.

        Raises:
            RigError: another trial had the id, or its record is kept no longer.
        """
        if request.trial_id in self._records:
            asked, record = self._records[request.trial_id]
            if request != asked:
                raise RigError(
                    f"trial {request.trial_id} has run with other gains or another profile; "
                    "a trial id is used once: ask under a new run name or attempt"
                )
            return record
        if request.trial_id in self._ids:
            raise RigError(
                f"trial {request.trial_id} has run, but the rig no longer holds its record; "
                "ask under another number or attempt"
            )
        return None


@contextlib.contextmanager
def stopped(trial: threading.Lock, stop: Callable[[], None]) -> Iterator[None]:
    """Holds the lock of a trial under way, having stopped it.

    Args:
        trial: Held while a trial runs.
        stop: Tells a trial to stop. Said again and again: one that is just beginning may not have
            heard it.
    """
    had = False
    while not had:
        stop()
        had = trial.acquire(timeout=STOP_AGAIN_S)
    try:
        yield
    finally:
        trial.release()
