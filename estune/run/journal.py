"""The durable record of a run: one SQLite file in one folder, the only place that writes state.

Every trial is committed before the next is asked for. The file is in WAL mode with
synchronous=FULL, so that what was acknowledged survives kill -9 and power loss, and readers never
block the writer. One process writes; a lock that dies with it keeps a second one out.
"""

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Self

from estune.core.gains import Gains
from estune.errors import JournalError, ProtocolError
from estune.run.session import Phase
from estune.support import sqlite
from estune.trial import Outcome, TrialRecord, TrialRequest, record_frame

FILE_NAME = "run.sqlite"
LOCK_NAME = "writer.lock"

VERSIONS = (
    """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trial (
    number INTEGER NOT NULL, attempt INTEGER NOT NULL, trial_id TEXT NOT NULL UNIQUE,
    phase TEXT NOT NULL, P REAL NOT NULL, I REAL NOT NULL, D REAL NOT NULL,
    setpoint_filter_s REAL NOT NULL, asked_at TEXT NOT NULL,
    outcome TEXT, reason TEXT, cost REAL, told_at TEXT, record BLOB,
    PRIMARY KEY (number, attempt)
)
""",
)
"""What makes each schema out of the one before it; the first makes it out of nothing."""

GO_ON = "go on with: estune resume"


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One trial as the journal holds it.

    Attributes:
        number: Place in the run.
        attempt: How often it had been void before.
        trial_id: Its id on the rig.
        phase: Its phase.
        gains: The gains asked for.
        outcome: How it ended; None while it is asked for but not told.
        reason: What happened, in words.
        cost: Its cost; nan where there is none.
    """

    number: int
    attempt: int
    trial_id: str
    phase: Phase
    gains: Gains
    outcome: Outcome | None = None
    reason: str = ""
    cost: float = float("nan")


class Journal:
    """A run on disk, open for reading, or for reading and writing by one process."""

    def __init__(self, folder: Path, connection: sqlite3.Connection, lock: IO[str] | None) -> None:
        self.folder = folder
        self._connection = connection
        self._lock = lock

    @classmethod
    def create(cls, folder: Path, facts: dict[str, Any]) -> Self:
        """Begins a run in a new folder.

        Args:
            folder: Where it will live.
            facts: What is known of the run before its first trial, as JSON values.

        Raises:
            JournalError: the folder holds a run already, or cannot be written.
        """
        if (folder / FILE_NAME).exists():
            raise JournalError(
                f"{folder} holds a run already; "
                f"choose another name, or go on with: estune resume {folder}"
            )
        with _explained(folder), ExitStack() as opened:
            folder.mkdir(parents=True, exist_ok=True)
            lock = opened.enter_context(_lock(folder))
            connection = sqlite.connect(opened, folder / FILE_NAME, "rwc")
            connection.execute("PRAGMA journal_mode=WAL")
            with sqlite.transaction(connection):
                sqlite.migrate(connection, VERSIONS)
                connection.executemany(
                    "INSERT INTO run VALUES (?, ?)", [(k, json.dumps(v)) for k, v in facts.items()]
                )
            opened.pop_all()
        return cls(folder, connection, lock)

    @classmethod
    def open(cls, folder: Path, *, write: bool = False) -> Self:
        """Opens a run, for reading unless told otherwise.

        Raises:
            JournalError: there is no run, it is torn or from a newer version, or, for writing, it
                is locked by another process or read-only.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            raise JournalError(f"there is no run in {folder}; see what there is with: estune list")
        with _explained(folder), ExitStack() as opened:
            lock = opened.enter_context(_lock(folder)) if write else None
            # Without the right to write, SQLite cannot make the shared index a WAL reader needs.
            unshared = (
                not os.access(folder, os.W_OK) and not (folder / f"{FILE_NAME}-wal").exists()
            )
            mode = "rw" if write else "ro&immutable=1" if unshared else "ro"
            connection = sqlite.connect(opened, path, mode)
            sqlite.check_version(connection, path, len(VERSIONS), "a run")
            if write:
                sqlite.check_whole(connection, path)
            outdated = sqlite.version(connection) < len(VERSIONS)
            if outdated and write:
                with sqlite.transaction(connection):
                    sqlite.migrate(connection, VERSIONS)
            elif outdated:
                cls.open(folder, write=True).close()
            opened.pop_all()
        return cls(folder, connection, lock)

    def fact(self, key: str) -> Any:
        """What was noted of the run under this key, or None."""
        with _explained(self.folder):
            row = self._connection.execute("SELECT value FROM run WHERE key=?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])

    def note(self, **facts: Any) -> None:
        """Commits facts of the run, replacing earlier ones under the same keys."""
        with self._transaction():
            self._connection.executemany(
                "INSERT OR REPLACE INTO run VALUES (?, ?)",
                [(key, json.dumps(value)) for key, value in facts.items()],
            )

    def commit(
        self,
        told: tuple[TrialRequest, TrialRecord, float] | None,
        asked: tuple[TrialRequest, Phase] | None,
    ) -> None:
        """Commits a trial's end and the next one's request, in one transaction.

        Args:
            told: The request that was run, its record and its cost (nan where it has none).
            asked: The request about to be run, and its phase.

        Raises:
            JournalError: it could not be committed; nothing was changed.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        with self._transaction():
            if told is not None:
                request, record, cost = told
                self._connection.execute(
                    "UPDATE trial SET outcome=?, reason=?, cost=?, told_at=?, record=?"
                    " WHERE number=? AND attempt=?",
                    (
                        *(record.outcome.value, record.reason, cost, now),
                        *(record_frame.encode(record), request.number, request.attempt),
                    ),
                )
            if asked is not None:
                request, phase = asked
                self._connection.execute(
                    "INSERT OR IGNORE INTO trial (number, attempt, trial_id, phase,"
                    " P, I, D, setpoint_filter_s, asked_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    (
                        *(request.number, request.attempt, request.trial_id, phase.value),
                        *(*request.gains.as_tuple(), now),
                    ),
                )

    def entries(self) -> Iterator[JournalEntry]:
        """Every trial asked for, in order."""
        with _explained(self.folder):
            rows = self._connection.execute(
                "SELECT number, attempt, trial_id, phase, P, I, D, setpoint_filter_s,"
                " outcome, reason, cost FROM trial ORDER BY number, attempt"
            ).fetchall()
        for number, attempt, trial_id, phase, *gains, outcome, reason, cost in rows:
            yield JournalEntry(
                *(number, attempt, trial_id, Phase(phase), Gains(*gains)),
                outcome=None if outcome is None else Outcome(outcome),
                reason=reason or "",
                cost=float("nan") if cost is None else cost,
            )

    def record(self, trial_id: str) -> TrialRecord:
        """The record of one trial.

        Raises:
            JournalError: the run holds no record of that trial, or a damaged one.
        """
        with _explained(self.folder):
            row = self._connection.execute(
                "SELECT record FROM trial WHERE trial_id=?", (trial_id,)
            ).fetchone()
        if row is None or row[0] is None:
            raise JournalError(f"{self.folder} holds no record of trial {trial_id}")
        try:
            return record_frame.decode(row[0])
        except ProtocolError as error:
            raise JournalError(
                f"{self.folder / FILE_NAME}: the record of trial {trial_id} is damaged ({error}); "
                "restore the file from a copy"
            ) from error

    def close(self) -> None:
        """Closes the file and lets go of the lock. The journal is complete at any time before."""
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with _explained(self.folder), sqlite.transaction(self._connection):
            yield


def being_written(folder: Path) -> bool:
    """Whether a process holds the right to write the run in this folder."""
    return sqlite.being_written(folder / LOCK_NAME)


def _lock(folder: Path) -> IO[str]:
    return sqlite.lock(folder / LOCK_NAME, f"the run in {folder}")


def _explained(folder: Path) -> AbstractContextManager[None]:
    return sqlite.explained(folder / FILE_NAME, GO_ON)
