"""Store of a sweep: one SQLite file in its folder, with a row for each finished cell."""

import json
import math
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import compress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import GAIN_NAMES, Gains
from estune.studies.sweep.cells import KEY_LENGTH, Cell
from estune.studies.sweep.outcome import FAILED, KIND, TRACE, CellOutcome
from estune.support.lazy_sequence import LazySequence
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

    def missing(self, cells: Sequence[Cell]) -> list[Cell]:
        """Those of some cells that are not finished, or failed.

        Raises:
            JournalError: the file cannot be read.
        """
        keys, missing = _Keys(cells), np.ones(len(cells), bool)
        for rows in self._pages("key, ending"):
            places = keys.places([key for key, ending in rows if ending != FAILED])
            missing[places[places >= 0]] = False
        return [cells[place] for place in np.flatnonzero(missing).tolist()]

    def outcomes(self, cells: Sequence[Cell]) -> LazySequence[CellOutcome]:
        """The stored outcomes of cells, in their order; their traces stay in the file.

        Raises:
            JournalError: the file cannot be read.
        """
        keys = _Keys(cells)
        stored = _PackedOutcomes(cells, self._file.path)
        for rows in self._pages("key, ending, message, facts, length(trace)"):
            places = keys.places([row[0] for row in rows]).tolist()
            for place, (_, *row) in zip(places, rows, strict=True):
                if place >= 0:
                    stored.add(place, row)
        return LazySequence(stored.places, stored.outcome)

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


class _Keys:
    """Places of cells by their keys, which are held as one sorted array."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        keys = np.fromiter((cell.key.encode() for cell in cells), f"S{KEY_LENGTH}", len(cells))
        self._order = np.argsort(keys)
        self._keys = keys[self._order]

    def places(self, keys: Sequence[str]) -> NDArray[np.int64]:
        """The place of each key; -1 for those of other cells."""
        wanted = np.array(keys, f"S{KEY_LENGTH}")
        at = np.minimum(np.searchsorted(self._keys, wanted), self._keys.size - 1)
        return np.where(self._keys[at] == wanted, self._order[at], -1)


_PACKED = struct.Struct(f"<4i??{2 * len(GAIN_NAMES) + len(_NUMBERS)}d")
"""Ending, message, trials, unsafe trials; whether there are gains and errors; these, numbers."""


class _PackedOutcomes:
    """Outcomes of many cells as bytes: 0.12 kB each, a sixth of their objects."""

    def __init__(self, cells: Sequence[Cell], path: Path) -> None:
        self._cells, self._path = cells, path
        self._packed = bytearray(len(cells) * _PACKED.size)
        self._stored = bytearray(len(cells))
        self._texts: dict[str, int] = {}
        self._text_of: list[str] = []

    @property
    def places(self) -> Sequence[int]:
        """Places of the cells that have an outcome."""
        return array("q", compress(range(len(self._cells)), self._stored))

    def add(self, place: int, row: Sequence[Any]) -> None:
        """Takes in a row of the file: ending, message, facts, and bytes of the trace."""
        ending, message, facts, trace_bytes = row
        values = json.loads(facts)
        gains, errors = values["gains"], values["log_errors"]
        none, numbers = (0.0,) * len(GAIN_NAMES), map(float, (values[name] for name in _NUMBERS))
        _PACKED.pack_into(
            *(self._packed, place * _PACKED.size, self._number(ending), self._number(message)),
            *(trace_bytes // (8 * len(TRACE)), values.get("unsafe_trials", -1)),
            *(gains is not None, errors is not None),
            *(*(gains or none), *(map(float, errors) if errors else none), *numbers),
        )
        self._stored[place] = 1

    def outcome(self, place: int) -> CellOutcome:
        row = _PACKED.unpack_from(self._packed, place * _PACKED.size)
        ending, message, trials, unsafe_trials, has_gains, has_errors, *values = row
        count = len(GAIN_NAMES)
        outcome = CellOutcome(
            self._cells[place],
            self._text_of[ending],
            self._text_of[message],
            gains=Gains(*values[:count]) if has_gains else None,
            log_errors=tuple(values[count : 2 * count]) if has_errors else None,
            trials=trials,
            unsafe_trials=unsafe_trials,
            trace_source=self._path,
            **dict(zip(_NUMBERS, values[2 * count :], strict=True)),
        )
        if unsafe_trials >= 0:
            return outcome
        return replace(outcome, unsafe_trials=int(outcome.trace[:, -1].sum()))  # an early version

    def _number(self, text: str) -> int:
        """The number of a text; equal ones are kept once."""
        number = self._texts.setdefault(text, len(self._text_of))
        if number == len(self._text_of):
            self._text_of.append(text)
        return number


def _to_json(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)
