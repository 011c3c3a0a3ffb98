"""Store of a sweep: one SQLite file in its folder, with a row for each finished cell."""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from estune.core.gains import Gains
from estune.studies.sweep.cells import Cell
from estune.studies.sweep.outcome import FAILED, KIND, TRACE, CellOutcome
from estune.support.sqlite import SqliteFile

FILE_NAME = "sweep.sqlite"
RUNS = "runs"
"""Folder of the runs on rigs at endpoints."""

_NUMBERS = ("cost", "cost_error", "start_cost", "remaining", "duration_s")
_ROWS_AT_ONCE = 2000


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

    def add(self, *outcomes: CellOutcome) -> None:
        """Commits outcomes, which replace earlier failures of their cells and nothing else.

        Raises:
            JournalError: they could not be written, or a cell is finished already.
        """
        finished_at = datetime.now(UTC).isoformat(timespec="milliseconds")
        with self._file.transaction():
            for outcome in outcomes:
                cell = outcome.cell
                self._file.write("DELETE FROM cell WHERE key = ? AND ending = ?", cell.key, FAILED)
                self._file.write(
                    "INSERT INTO cell VALUES (?, ?, ?, ?, ?, ?, ?)",
                    *(cell.key, cell.label, outcome.ending, outcome.message),
                    *(json.dumps(_facts(outcome)), outcome.trace.astype("<f8").tobytes()),
                    finished_at,
                )

    def missing(self, cells: Iterable[Cell]) -> list[Cell]:
        """Those of some cells that are not finished, or failed.

        Raises:
            JournalError: the file cannot be read.
        """
        missing = {cell.key: cell for cell in cells}
        for rows in self._pages("key, ending"):
            for key, ending in rows:
                if ending != FAILED:
                    missing.pop(key, None)
        return list(missing.values())

    def outcomes(self, cells: Sequence[Cell]) -> tuple[CellOutcome, ...]:
        """The stored outcomes of cells, in their order; their traces stay in the file.

        Raises:
            JournalError: the file cannot be read.
        """
        places = {cell.key: place for place, cell in enumerate(cells)}
        outcomes: list[CellOutcome | None] = [None] * len(cells)
        texts: dict[str, str] = {}
        for rows in self._pages("key, ending, message, facts, length(trace)"):
            for key, ending, message, *rest in rows:
                if (place := places.get(key)) is not None:
                    shared = (texts.setdefault(text, text) for text in (ending, message))
                    row = (*shared, *rest)
                    outcomes[place] = _outcome(cells[place], self._file.path, row)
        return tuple(outcome for outcome in outcomes if outcome is not None)

    def _pages(self, columns: str) -> Iterator[list[Any]]:
        """Columns of all cells, a number of rows at a time; the first column is the key."""
        last = ""
        while rows := self._file.rows(
            f"SELECT {columns} FROM cell WHERE key > ? ORDER BY key LIMIT ?",  # noqa: S608  ours
            *(last, _ROWS_AT_ONCE),
        ):
            yield rows
            last = rows[-1][0]


def _facts(outcome: CellOutcome) -> dict[str, Any]:
    """The numbers as JSON values; those that are not finite as text."""
    gains, errors = outcome.gains, outcome.log_errors
    return {
        "gains": None if gains is None else list(gains.as_tuple()),
        "log_errors": None if errors is None else [_to_json(error) for error in errors],
        **{name: _to_json(getattr(outcome, name)) for name in _NUMBERS},
        "unsafe_trials": outcome.unsafe_trials,
    }


def _outcome(cell: Cell, path: Path, row: Sequence[Any]) -> CellOutcome:
    """The outcome in a row: ending, message, facts, and bytes of the trace."""
    ending, message, facts, trace_bytes = row
    values = json.loads(facts)
    gains, errors = values["gains"], values["log_errors"]
    outcome = CellOutcome(
        cell,
        ending,
        message,
        gains=None if gains is None else Gains(*gains),
        log_errors=None if errors is None else tuple(map(float, errors)),
        trials=trace_bytes // (8 * len(TRACE)),
        unsafe_trials=values.get("unsafe_trials", 0),
        trace_source=path,
        **{name: float(values[name]) for name in _NUMBERS},
    )
    if "unsafe_trials" in values:
        return outcome
    return replace(outcome, unsafe_trials=int(outcome.trace[:, -1].sum()))  # an earlier version


def _to_json(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)
