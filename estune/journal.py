"""The durable record of a run: one SQLite file in one folder, the only place that writes state.

Every trial is committed before the next is asked for. The file is in WAL mode with
synchronous=FULL, so that what was acknowledged survives kill -9 and power loss, and readers never
block the writer. One process writes; a lock that dies with it keeps a second one out.
"""

import fcntl
import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Self

from estune import frame
from estune.core.gains import Gains
from estune.errors import JournalError, ProtocolError
from estune.session import Phase
from estune.trial import Outcome, TrialRecord, TrialRequest

FILE_NAME = "run.sqlite"
LOCK_NAME = "writer.lock"
SCHEMA_VERSION = 1

_SCHEMA = """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trial (
    number INTEGER NOT NULL, attempt INTEGER NOT NULL, trial_id TEXT NOT NULL UNIQUE,
    phase TEXT NOT NULL, P REAL NOT NULL, I REAL NOT NULL, D REAL NOT NULL,
    setpoint_filter_s REAL NOT NULL, asked_at TEXT NOT NULL,
    outcome TEXT, reason TEXT, cost REAL, told_at TEXT, record BLOB,
    PRIMARY KEY (number, attempt)
);
"""


@dataclass(frozen=True, slots=True)
class Entry:
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
            connection = _connect(opened, folder, "rwc")
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("BEGIN IMMEDIATE")
            for statement in _SCHEMA.split(";"):
                connection.execute(statement)
            connection.executemany(
                "INSERT INTO run VALUES (?, ?)", [(k, json.dumps(v)) for k, v in facts.items()]
            )
            connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            connection.execute("COMMIT")
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
            connection = _connect(opened, folder, mode)
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if version != SCHEMA_VERSION:
                remedy = "use a newer" if version > SCHEMA_VERSION else "it is not a run of"
                raise JournalError(
                    f"{path} has schema version {version}, this estune knows {SCHEMA_VERSION}; "
                    f"{remedy} estune"
                )
            if write:
                fault = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
                if fault != "ok":
                    raise JournalError(f"{path} is damaged ({fault}); restore it from a copy")
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
                        *(frame.encode(record), request.number, request.attempt),
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

    def entries(self) -> Iterator[Entry]:
        """Every trial asked for, in order."""
        with _explained(self.folder):
            rows = self._connection.execute(
                "SELECT number, attempt, trial_id, phase, P, I, D, setpoint_filter_s,"
                " outcome, reason, cost FROM trial ORDER BY number, attempt"
            ).fetchall()
        for number, attempt, trial_id, phase, *gains, outcome, reason, cost in rows:
            yield Entry(
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
            return frame.decode(row[0])
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
        with _explained(self.folder):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise


def being_written(folder: Path) -> bool:
    """Whether a process holds the right to write the run in this folder."""
    try:
        with (folder / LOCK_NAME).open() as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (
        OSError
    ):  # no lock was ever taken, or this user may not look: nothing says it is written
        return False
    return False


def _connect(opened: ExitStack, folder: Path, mode: str) -> sqlite3.Connection:
    """A connection whose transactions are ours to begin and end, closed again on failure."""
    address = f"{(folder / FILE_NAME).resolve().as_uri()}?mode={mode}"
    connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=2.0)
    opened.callback(connection.close)
    connection.execute("PRAGMA synchronous=FULL")
    return connection


def _lock(folder: Path) -> IO[str]:
    """The right to write, held until closed and let go by the system if the process dies."""
    lock = (folder / LOCK_NAME).open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise JournalError(
            f"the run in {folder} is being written by another process; wait for it or stop it"
        ) from None
    return lock


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Turns what sqlite3 and the file system say into what the user can do about it."""
    try:
        yield
    except sqlite3.Error as error:
        said = str(error)
        remedies = {
            "locked": "another program holds the file; close it and go on with: estune resume",
            "readonly": "give write permission to the folder and the file",
            "unable to open": "give write permission to the folder and the file",
            "malformed": "the file is damaged; restore it from a copy",
            "not a database": "the file is damaged or no run of estune; restore it from a copy",
            "full": "the disk is full; make room and go on with: estune resume",
        }
        remedy = next((remedies[key] for key in remedies if key in said), "see the message")
        raise JournalError(f"{folder / FILE_NAME}: {said}; {remedy}") from error
    except OSError as error:
        raise JournalError(
            f"{folder}: {error.strerror or error}; choose a folder that can be written"
        ) from error
