"""Data of the tuning page: the loop identified from a run, anew when there are more trials."""

import threading
from collections.abc import Callable
from pathlib import Path

from estune import api
from estune.errors import EstuneError
from estune.run.journal import Journal
from estune.run.results.tuning_data import tuning_data
from estune.web.board import to_json

TRIALS_MAX = 2000
"""Trials of an unfinished run up to which its loop is shown: reading it restores its tuner."""


class TuningSource:
    """The data of a tuning page; any thread may ask.

    Args:
        choose: The run that is shown now; None where there is none.
    """

    def __init__(self, choose: Callable[[], Path | None] = lambda: None) -> None:
        self._choose = choose
        self._lock = threading.Lock()
        self._made: tuple[Path | None, int, str] = None, -1, ""
        self._text = ""

    def text(self) -> str:
        """The data as JSON: `{"data": ..., "reason": ...}`, one of them empty."""
        folder = self._choose()
        if folder is None:
            return _without("there is no run whose records show the loop; tune this rig first")
        with self._lock:
            try:
                with Journal.open(folder) as journal:
                    status = str(journal.fact("status"))
                    trials = sum(entry.outcome is not None for entry in journal.entries())
                made = folder, trials, status
                if made != self._made:
                    self._text = _text(folder, trials, status)
                    self._made = made
            except EstuneError as error:
                return _without(str(error))
            return self._text


def _text(folder: Path, trials: int, status: str) -> str:
    if status != "finished" and trials > TRIALS_MAX:
        return _without(f"the run has {trials} trials; its loop is shown once it is finished")
    result = api.load(folder)
    data = tuning_data(result)
    if data is None:
        reason = result.identified.reason
        return _without(f"no loop was identified from the records of this run: {reason}")
    return to_json({"data": data, "reason": ""})


def _without(reason: str) -> str:
    return to_json({"data": None, "reason": reason})
