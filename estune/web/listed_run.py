"""A run in one row of the list, from its journal alone, read anew when the journal has changed."""

import os
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from estune.errors import EstuneError
from estune.run.journal import FILE_NAME, Journal, being_written
from estune.run.labels import LABELS, NUMBERS, ListedNumbers, read_labels, read_numbers
from estune.run.tally import Tally
from estune.run.targets import is_endpoint


class ListedRun:
    """The row of one run. Any thread may ask.

    Attributes:
        target: Where its trials are made, as of the last row; empty before, if unreadable, or
            where an object was given.
        last_at: When its last trial ended, or it began, as of the last row.
        took_s: Time from its begin until then, s.
    """

    def __init__(self, folder: Path) -> None:
        self.target = ""
        self.folder = folder
        self.last_at = datetime.min.replace(tzinfo=UTC)
        self.took_s = 0.0
        names = (FILE_NAME, f"{FILE_NAME}-wal", LABELS, NUMBERS)
        self._files = [os.path.join(folder, name) for name in names]  # noqa: PTH118  10 times faster
        self._read: tuple[tuple[int, ...], dict[str, Any]] = (), {}

    @property
    def is_of_rig(self) -> bool:
        """Whether its trials were made on a rig, as far as is known, not on a named model."""
        return not self.target or is_endpoint(self.target)

    @property
    def is_running(self) -> bool:
        """Whether a process is making its trials."""
        return bool(self.row().get("state") == "running")

    def row(self) -> dict[str, Any]:
        """Rig, time of the begin, state, trials, costs, response, tags and note.

        The same object as long as none of them has changed.
        """
        stamp = self._stamp()
        if stamp != self._read[0]:
            self._read = stamp, self._row()
        row = self._read[1]
        if row.get("state") == "running" and not being_written(self.folder):
            return row | {"state": "interrupted"}
        return row

    def _stamp(self) -> tuple[int, ...]:
        """Times at which the run's files were written; 0 of one that is not there."""
        times = [0] * len(self._files)
        for n, file in enumerate(self._files):
            with suppress(OSError):
                times[n] = os.stat(file).st_mtime_ns  # noqa: PTH116  as above
        return tuple(times)

    def _row(self) -> dict[str, Any]:
        try:
            with Journal.open(self.folder, briefly=True) as journal:
                entries = [(e.phase, e.outcome, e.cost) for e in journal.entries() if e.outcome]
                status, begun = str(journal.fact("status")), journal.fact("created_at")
                rig = journal.fact("rig")["name"]
                self.target = journal.fact("target") or ""
                ended = journal.ended_at()
        except EstuneError as error:
            return {"state": f"unreadable: {error}"}
        begun_at = datetime.fromisoformat(begun).astimezone()
        self.last_at = ended[-1] if ended else begun_at
        self.took_s = (self.last_at - begun_at).total_seconds()
        # Without the limit of the plan: the start is below it, and the best below the start.
        tally = Tally(None).after(entries)
        shown = ListedNumbers(start_cost=tally.start_cost, cost=tally.best and tally.best[0])
        stored = read_numbers(self.folder)._asdict().items()
        numbers = shown._replace(**{name: x for name, x in stored if x is not None})
        return {
            "rig": rig,
            "begun": begun,
            "state": status.partition(":")[0],
            "trials": len(entries),
            **numbers._asdict(),
            **read_labels(self.folder)._asdict(),
        }
