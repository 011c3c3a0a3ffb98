"""Store of a sweep: one SQLite file in its folder, with a row for each finished cell."""

import json
import math
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from estune.core.gains import Gains
from estune.studies.sweep.cells import Cell
from estune.studies.sweep.outcome import FAILED, TRACE, CellOutcome
from estune.support.sqlite import FileKind, SqliteFile

FILE_NAME = "sweep.sqlite"
RUNS = "runs"
"""Folder of the runs on rigs at endpoints."""

KIND = FileKind(
    "a sweep's file",
    (
        """
CREATE TABLE cell (
    key TEXT PRIMARY KEY, label TEXT NOT NULL, ending TEXT NOT NULL, message TEXT NOT NULL,
    facts TEXT NOT NULL, trace BLOB NOT NULL, finished_at TEXT NOT NULL
) WITHOUT ROWID
""",
    ),
    "call the sweep again",
    lock_name="sweep.lock",
)

_NUMBERS = ("cost", "cost_error", "start_cost", "remaining", "duration_s")


class SweepStore:
    """The outcomes of one sweep, open for the one process that writes them."""

    def __init__(self, folder: Path, file: SqliteFile) -> None:
        """Use `open`."""
        self.folder = folder
        self._file = file

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Opens the sweep of a folder, or begins one.

        Raises:
            JournalError: another process writes it, it is from a newer version, damaged, or cannot
                be written.
        """
        return cls(folder, SqliteFile.open_writer(folder / FILE_NAME, KIND))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, outcome: CellOutcome) -> None:
        """Commits an outcome, which replaces an earlier failure of its cell and nothing else.

        Raises:
            JournalError: it could not be written, or the cell is finished already.
        """
        cell = outcome.cell
        with self._file.transaction():
            self._file.write("DELETE FROM cell WHERE key = ? AND ending = ?", cell.key, FAILED)
            self._file.write(
                "INSERT INTO cell VALUES (?, ?, ?, ?, ?, ?, ?)",
                *(cell.key, cell.label, outcome.ending, outcome.message),
                *(json.dumps(_facts(outcome)), outcome.trace.astype("<f8").tobytes()),
                datetime.now(UTC).isoformat(timespec="milliseconds"),
            )

    def outcomes(self, cells: Iterable[Cell]) -> dict[str, CellOutcome]:
        """The stored outcomes of some cells, by key.

        Raises:
            JournalError: the file cannot be read.
        """
        rows = self._file.rows("SELECT key, ending, message, facts, trace FROM cell")
        stored = {key: rest for key, *rest in rows}
        return {c.key: _outcome(c, *stored[c.key]) for c in cells if c.key in stored}


def _facts(outcome: CellOutcome) -> dict[str, Any]:
    """The numbers as JSON values; those that are not finite as text."""
    gains, errors = outcome.gains, outcome.log_errors
    return {
        "gains": None if gains is None else list(gains.as_tuple()),
        "log_errors": None if errors is None else [_to_json(error) for error in errors],
        **{name: _to_json(getattr(outcome, name)) for name in _NUMBERS},
    }


def _outcome(cell: Cell, ending: str, message: str, facts: str, trace: bytes) -> CellOutcome:
    values = json.loads(facts)
    gains, errors = values["gains"], values["log_errors"]
    return CellOutcome(
        cell,
        ending,
        message,
        gains=None if gains is None else Gains(*gains),
        log_errors=None if errors is None else tuple(map(float, errors)),
        trace=np.frombuffer(trace, "<f8").reshape(-1, len(TRACE)).astype(np.float64),
        **{name: float(values[name]) for name in _NUMBERS},
    )


def _to_json(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)
