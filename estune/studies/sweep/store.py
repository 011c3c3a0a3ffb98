"""What a sweep must not lose: one SQLite file in its folder, a row for each finished cell.

A cell is committed as soon as it is done, by the one process that drives the sweep. How the file
is opened, locked and synchronised is `estune.support.sqlite`'s.
"""

import json
import math
import sqlite3
from collections.abc import Iterable
from contextlib import AbstractContextManager, ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from estune.core.gains import Gains
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.outcome import FAILED, TRACE, CellOutcome
from estune.support import sqlite

FILE_NAME = "sweep.sqlite"
LOCK_NAME = "sweep.lock"
RUNS = "runs"
"""Folder of the runs on rigs at endpoints."""

VERSIONS = (
    """
CREATE TABLE cell (
    key TEXT PRIMARY KEY, label TEXT NOT NULL, ending TEXT NOT NULL, message TEXT NOT NULL,
    facts TEXT NOT NULL, trace BLOB NOT NULL, finished_at TEXT NOT NULL
) WITHOUT ROWID
""",
)
"""What makes each schema out of the one before it; the first makes it out of nothing."""

_NUMBERS = ("cost", "cost_error", "start_cost", "remaining", "duration_s")


class Store:
    """The file of one sweep, open for the one process that writes it."""

    def __init__(self, folder: Path, connection: sqlite3.Connection, opened: ExitStack) -> None:
        self.folder = folder
        self._connection = connection
        self._opened = opened

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Opens the sweep of a folder, or begins one.

        Raises:
            JournalError: another process writes it, it is from a newer version, damaged, or cannot
                be written.
        """
        path = folder / FILE_NAME
        with _explained(folder), ExitStack() as opened:
            folder.mkdir(parents=True, exist_ok=True)
            opened.enter_context(sqlite.lock(folder / LOCK_NAME, f"the sweep in {folder}"))
            connection = sqlite.connect(opened, path, "rwc")
            if sqlite.version(connection) != 0:
                sqlite.check_version(connection, path, len(VERSIONS), "a sweep's file")
                sqlite.check_whole(connection, path)
            connection.execute("PRAGMA journal_mode=WAL")
            with sqlite.transaction(connection):
                sqlite.migrate(connection, VERSIONS)
            return cls(folder, connection, opened.pop_all())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def keep(self, outcome: CellOutcome) -> None:
        """Commits what a cell came to. A failure gives way to a later one; what is done stays.

        Raises:
            JournalError: it could not be written, or the cell is done already.
        """
        row = (
            *(outcome.cell.key, outcome.cell.label, outcome.ending, outcome.message),
            *(json.dumps(_facts(outcome)), outcome.trace.astype("<f8").tobytes()),
            datetime.now(UTC).isoformat(timespec="milliseconds"),
        )
        with _explained(self.folder), sqlite.transaction(self._connection):
            self._connection.execute(
                "DELETE FROM cell WHERE key = ? AND ending = ?", (outcome.cell.key, FAILED)
            )
            self._connection.execute("INSERT INTO cell VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def outcomes(self, cells: Iterable[Cell]) -> dict[str, CellOutcome]:
        """What is kept of some cells, by key.

        Raises:
            JournalError: the file cannot be read.
        """
        with _explained(self.folder):
            rows = self._connection.execute(
                "SELECT key, ending, message, facts, trace FROM cell"
            ).fetchall()
        kept = {key: rest for key, *rest in rows}
        return {cell.key: _outcome(cell, *kept[cell.key]) for cell in cells if cell.key in kept}


def _facts(outcome: CellOutcome) -> dict[str, Any]:
    """The numbers as JSON values; those that are not finite are text."""
    gains, errors = outcome.gains, outcome.log_errors
    return {
        "gains": None if gains is None else list(gains.as_tuple()),
        "log_errors": None if errors is None else [_written(error) for error in errors],
        **{name: _written(getattr(outcome, name)) for name in _NUMBERS},
    }


def _outcome(cell: Cell, ending: str, message: str, facts: str, trace: bytes) -> CellOutcome:
    said = json.loads(facts)
    gains, errors = said["gains"], said["log_errors"]
    return CellOutcome(
        cell,
        ending,
        message,
        gains=None if gains is None else Gains(*gains),
        log_errors=None if errors is None else tuple(map(float, errors)),
        trace=np.frombuffer(trace, "<f8").reshape(-1, len(TRACE)).astype(np.float64),
        **{name: float(said[name]) for name in _NUMBERS},
    )


def _written(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)


def _explained(folder: Path) -> AbstractContextManager[None]:
    return sqlite.explained(folder / FILE_NAME, "call the sweep again")
