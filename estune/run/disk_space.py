"""Forecast of when a run will have filled its disk."""

import shutil
import time

from estune.run.journal import Journal

INTERVAL = 50
"""Trials between two measurements."""

NOTICE_s = 86400.0
"""Time before the end of the disk at which a run says so, s."""


class DiskForecast:
    """Rate of growth of a journal against the free space of its disk."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._began_s, self._began_bytes = time.monotonic(), journal.size_bytes()
        self._trials = 0
        self._warning = ""

    def warning(self, trials_left: int) -> str:
        """To be called after each trial: that the disk will be full within a day, or nothing."""
        self._trials += 1
        if self._trials % INTERVAL == 0:
            self._warning = self._forecast(trials_left)
        return self._warning

    def _forecast(self, trials_left: int) -> str:
        per_trial = (self._journal.size_bytes() - self._began_bytes) / self._trials
        try:
            free = shutil.disk_usage(self._journal.folder).free
        except OSError:  # the folder is gone; the next commit says so
            return ""
        if per_trial * trials_left <= free:
            return ""
        left_s = free / per_trial * (time.monotonic() - self._began_s) / self._trials
        if left_s > NOTICE_s:
            return ""
        return (
            f"the disk will be full in {left_s / 3600.0:.2g} h ({free / 1e6:.3g} MB free, "
            f"{per_trial * trials_left / 1e6:.3g} MB needed): make room, or tune with --records"
        )
