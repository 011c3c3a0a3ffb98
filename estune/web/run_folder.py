"""The runs of a folder, each read once for all pages that show it."""

import math
import os
import threading
import time
from contextlib import suppress
from pathlib import Path

from estune.run.journal import FILE_NAME
from estune.web.listed_run import ListedRun

RUNS_MAX = 2000
"""Newest runs of a folder that are listed."""
LOOK_S = 0.5
"""Least time between two looks at the folder for the runs of a rig, s: 1000 runs take 10 ms."""


class RunFolder:
    """A folder of runs. Any thread may ask.

    Args:
        path: The folder; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[Path, ListedRun] = {}
        self._lock = threading.Lock()
        self._of_rigs: dict[str, tuple[float, list[ListedRun]]] = {}

    def newest(self) -> list[ListedRun]:
        """At most `RUNS_MAX` runs, the one written last first; the same objects each time."""
        written: dict[str, float] = {}
        with suppress(FileNotFoundError), os.scandir(self.path) as entries:
            for entry in entries:
                with suppress(OSError):
                    written[entry.path] = Path(entry.path, FILE_NAME).stat().st_ctime
        names = sorted(written, key=lambda path: written[path], reverse=True)
        paths = [Path(name) for name in names[:RUNS_MAX]]
        with self._lock:
            self._known = {p: self._known.get(p) or ListedRun(p) for p in paths}
            return list(self._known.values())

    def of_rig(self, rig: str) -> list[ListedRun]:
        """The runs that name a rig, but for those on a model; the last trial's run first."""
        looked_at_s, found = self._of_rigs.get(rig, (-math.inf, []))
        if time.monotonic() - looked_at_s >= LOOK_S:
            runs = [one for one in self.newest() if one.row().get("rig") == rig and one.is_of_rig]
            found = sorted(runs, key=lambda one: one.last_at, reverse=True)
            self._of_rigs[rig] = time.monotonic(), found
        return found
