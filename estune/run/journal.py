"""The durable record of a run: one SQLite file in one folder, the only place that writes state.

Every trial is committed before the next one is requested.
"""

import contextlib
import json
import math
import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from estune.errors import JournalError, ProtocolError
from estune.run.phase import Phase
from estune.run.submitted_trial import SubmittedTrial
from estune.support.closing import Closing
from estune.support.garbage import collection_paused
from estune.support.sqlite import FileKind, SqliteFile, has_writer
from estune.trial.outcome import Outcome

if TYPE_CHECKING:
    from estune.core.gains import Gains
    from estune.trial import TrialRecord, TrialRequest

RUNS = "runs"
"""Folder of runs, unless another one is given."""

FILE_NAME = "run.sqlite"

VERSIONS = (
    # Records have a table of their own, so that the trials are read without them.
    """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trial (
    number INTEGER NOT NULL, attempt INTEGER NOT NULL, trial_id TEXT NOT NULL UNIQUE,
    phase TEXT NOT NULL, P REAL NOT NULL, I REAL NOT NULL, D REAL NOT NULL,
    setpoint_filter_s REAL NOT NULL, asked_at TEXT NOT NULL,
    outcome TEXT, reason TEXT, cost REAL, margin REAL, told_at TEXT,
    PRIMARY KEY (number, attempt)
);
CREATE TABLE record (
    number INTEGER NOT NULL, attempt INTEGER NOT NULL, frame BLOB NOT NULL,
    PRIMARY KEY (number, attempt)
);
CREATE TABLE snapshot (
    trials INTEGER NOT NULL, version TEXT NOT NULL, digest TEXT NOT NULL, state BLOB NOT NULL
)
""",
)
"""SQL that makes each schema out of the one before it; the first begins an empty file."""

KIND = FileKind(
    "a run",
    VERSIONS,
    "continue with: estune resume {folder}",
    lock_name="writer.lock",
    checksummed=("record",),
)


class JournalEntry(NamedTuple):
    """One trial in the journal.

    Attributes:
        attempt: How many void attempts of this trial precede it.
        gain_values: The requested gains, in the order of `Gains.as_tuple`.
        outcome: How it ended; None while it is under way.
        cost: Its cost; nan where there is none.
        margin: Its constraint margin; infinite while the trial is under way.
    """

    number: int
    attempt: int
    trial_id: str
    phase: Phase
    gain_values: tuple[float, float, float, float]
    outcome: Outcome | None = None
    reason: str = ""
    cost: float = math.nan
    margin: float = math.inf

    @property
    def gains(self) -> "Gains":
        """The requested gains."""
        from estune.core.gains import Gains  # noqa: PLC0415  slow to import

        return Gains(*self.gain_values)


class CompletedTrial(NamedTuple):
    """A trial to be committed; the reason is its outcome in words, or why it has no cost."""

    request: "TrialRequest"
    record: "TrialRecord"
    cost: float
    margin: float
    reason: str = ""


class StoredSnapshot(NamedTuple):
    """A snapshot of the session after so many trials.

    Attributes:
        version: `code_version` of the program that wrote it.
        digest: Of the trials.
        state: The session, pickled without its plan.
    """

    trials: int
    version: str
    digest: str
    state: bytes


RECORDS_LEAST = 1000
"""Fewest records that a run may keep; a resumed run may read as many."""

_PHASES = {phase.value: phase for phase in Phase}
_OUTCOMES: dict[str | None, Outcome | None] = {outcome.value: outcome for outcome in Outcome}
_OUTCOMES[None] = None


class Journal(Closing):
    """A run on disk, open for reading, or for reading and writing by one process."""

    def __init__(self, file: SqliteFile) -> None:
        self.folder = file.path.parent
        self._file = file
        self._records_max: int | None = self.fact("records_max")

    @classmethod
    def create(cls, folder: Path, facts: dict[str, Any]) -> Self:
        """Begins a run in a new folder, with facts as JSON values.

        Raises:
            JournalError: the folder holds a run already, or cannot be written.
        """
        exists = JournalError(
            f"{folder} holds a run already; "
            f"choose another name, or continue it with: estune resume {shlex.quote(str(folder))}"
        )
        if (folder / FILE_NAME).exists():
            raise exists

        def write_facts(file: SqliteFile) -> None:
            if not file.is_new:  # begun by another process a moment ago
                raise exists
            _write_facts(file, facts)

        return cls(SqliteFile.open_writer(folder / FILE_NAME, KIND, prepare=write_facts))

    def discard(self) -> None:
        """Closes the journal and removes it, with its folder if that is empty then."""
        self.close()
        for path in (*self.folder.glob(f"{FILE_NAME}*"), self.folder / KIND.lock_name):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    @classmethod
    def open(cls, folder: Path, *, write: bool = False, briefly: bool = False) -> Self:
        """Opens a run; `briefly` as in `SqliteFile.open_reader`.

        Raises:
            JournalError: there is no run, it is torn or from a newer version, or, for writing, it
                is locked by another process or read-only.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            raise JournalError(f"there is no run in {folder}; list the runs with: estune list")
        if write:
            return cls(SqliteFile.open_writer(path, KIND, create=False))
        return cls(SqliteFile.open_reader(path, KIND, briefly=briefly))

    def fact(self, key: str) -> Any:
        """The fact of the run stored under a key, or None."""
        rows = self._file.rows("SELECT value FROM run WHERE key=?", key)
        return json.loads(rows[0][0]) if rows else None

    def note(self, **facts: Any) -> None:
        """Commits facts of the run, replacing earlier ones under the same keys."""
        _write_facts(self._file, facts)

    @property
    def submitted(self) -> SubmittedTrial | None:
        """The trial last submitted to a rig that moves and keeps a ledger; None without one."""
        stored = self.fact("submitted")
        return None if stored is None else SubmittedTrial(*stored)

    @submitted.setter
    def submitted(self, trial: SubmittedTrial | None) -> None:
        self.note(submitted=trial)

    def commit(
        self, finished: CompletedTrial | None, following: "tuple[TrialRequest, Phase] | None"
    ) -> None:
        """Commits a finished trial with its record and cost, and the request that follows it.

        Raises:
            JournalError: it could not be committed; nothing was changed.
        """
        from estune.run.compressed_frame import compress  # noqa: PLC0415  slow to import
        from estune.trial import record_frame  # noqa: PLC0415  slow to import

        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        frame = compress(record_frame.encode(finished.record)) if finished else b""
        # At once: a crash between the two would leave a trial that may move the rig unknown to the
        # run that resumes.
        with self._file.transaction():
            if finished is not None:
                request, record = finished.request, finished.record
                place = request.number, request.attempt
                self._file.write(
                    "UPDATE trial SET outcome=?, reason=?, cost=?, margin=?, told_at=?"
                    " WHERE number=? AND attempt=?",
                    *(record.outcome.value, finished.reason, finished.cost, finished.margin, now),
                    *place,
                )
                self._file.write("INSERT INTO record VALUES (?, ?, ?)", *place, frame)
                if self._records_max is not None:
                    self._drop_records_to(request.number - self._records_max)
            if following is not None:
                request, phase = following
                # A run that resumes asks again for the trial that was under way.
                self._file.write(
                    "INSERT OR IGNORE INTO trial (number, attempt, trial_id, phase,"
                    " P, I, D, setpoint_filter_s, asked_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    *(request.number, request.attempt, request.trial_id, phase.value),
                    *(*request.gains.as_tuple(), now),
                )

    def _drop_records_to(self, number: int) -> None:
        """Drops records of the search up to a number: the latest `records_max` are kept."""
        self._file.write(
            "DELETE FROM record WHERE rowid IN (SELECT record.rowid FROM record"
            " JOIN trial USING (number, attempt) WHERE number <= ? AND phase = ?)",
            *(number, Phase.SEARCH.value),
        )

    def changes(self) -> int:
        """A number that changes with every commit of another process."""
        return int(self._file.rows("PRAGMA data_version")[0][0])

    def entries(self, skip: int = 0) -> list[JournalEntry]:
        """Every requested trial, in order, but for the first ones."""
        nan, entries = math.nan, []
        with collection_paused():
            rows = self._file.rows(  # trials are requested in the order of their rows
                "SELECT number, attempt, trial_id, phase, P, I, D, setpoint_filter_s,"
                " outcome, reason, cost, margin FROM trial ORDER BY rowid LIMIT -1 OFFSET ?",
                skip,
            )
            for n, attempt, name, phase, P, I, D, filter_s, outcome, reason, cost, margin in rows:
                numbers = nan if cost is None else cost, math.inf if margin is None else margin
                ending = _OUTCOMES[outcome], reason or "", *numbers
                gains = P, I, D, filter_s
                entries.append(JournalEntry(n, attempt, name, _PHASES[phase], gains, *ending))
        return entries

    def ended_at(self, last: int = 1) -> list[datetime]:
        """When the last trials ended, in their order."""
        rows = self._file.rows(
            "SELECT told_at FROM trial WHERE told_at IS NOT NULL ORDER BY rowid DESC LIMIT ?", last
        )
        return [datetime.fromisoformat(at) for (at,) in reversed(rows)]

    def record(self, trial_id: str) -> "TrialRecord":
        """The record of one trial.

        Raises:
            JournalError: the run holds no record of that trial, or a damaged one.
        """
        from estune.run.compressed_frame import decompress  # noqa: PLC0415  slow to import
        from estune.trial import record_frame  # noqa: PLC0415  slow to import

        rows = self._file.rows(
            "SELECT frame FROM trial JOIN record USING (number, attempt) WHERE trial_id=?",
            trial_id,
        )
        if not rows:
            kept = f"; it keeps the latest {self._records_max}" if self._records_max else ""
            raise JournalError(f"{self.folder} holds no record of trial {trial_id}{kept}")
        try:
            return record_frame.decode(decompress(rows[0][0]))
        except ProtocolError as error:
            raise JournalError(
                f"{self._file.path}: the record of trial {trial_id} is damaged ({error}); "
                "restore the file from a copy"
            ) from error

    def stored_trial_ids(self) -> list[str]:
        """The ids of the trials of which there is a record, in order."""
        rows = self._file.rows(
            "SELECT trial_id FROM trial JOIN record USING (number, attempt)"
            " ORDER BY number, attempt"
        )
        return [trial_id for (trial_id,) in rows]

    def snapshot(self) -> StoredSnapshot | None:
        """The latest snapshot of the session; see `estune.run.snapshot`."""
        rows = self._file.rows("SELECT trials, version, digest, state FROM snapshot")
        return StoredSnapshot(*rows[0]) if rows else None

    def write_snapshot(self, snapshot: StoredSnapshot) -> None:
        """Commits a snapshot in place of the earlier one."""
        with self._file.transaction():
            self._file.write("DELETE FROM snapshot")
            self._file.write("INSERT INTO snapshot VALUES (?, ?, ?, ?)", *snapshot)

    def size_bytes(self) -> int:
        """Size of the file, without what SQLite has yet to move into it."""
        pages, page_size = self._file.rows("SELECT * FROM pragma_page_count, pragma_page_size")[0]
        return int(pages * page_size)

    def close(self) -> None:
        """Closes the file and releases the lock. The journal is complete at any time before."""
        self._file.close()


def being_written(folder: Path) -> bool:
    """Whether a process holds the right to write the run in this folder."""
    return has_writer(folder / FILE_NAME, KIND)


def _write_facts(file: SqliteFile, facts: dict[str, Any]) -> None:
    file.write_many(
        "INSERT OR REPLACE INTO run VALUES (?, ?)",
        ((key, json.dumps(value)) for key, value in facts.items()),
    )
