"""What a rig remembers of every trial it was ever asked for, so that none runs twice.

On a rig that moves, it is a file: one SQLite database in WAL mode with synchronous=FULL, so that
what was noted survives kill -9 and power loss. A trial is noted as accepted before its sender is
told so, as running before anything moves, and with its record once the live gains are back. When
the rig starts again, what was accepted has never started and what was running was interrupted.
The rig's emergency stop is remembered too.

Frames of the oldest trials are let go first; that they have run is remembered far longer.
"""

import logging
import secrets
import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import NamedTuple, Protocol

from estune.errors import EstuneError, JournalError, RigError
from estune.remote.state_machine.trials import TrialEvent, TrialState, after
from estune.support import sqlite

FRAMES_MAX_BYTES = 64 * 2**20
"""What the frames of a ledger may take on disk."""

MEMORY_MAX_BYTES = 8 * 2**20
"""What they may take in memory."""

TRIALS_MAX = 1_000_000
"""How many trials are remembered at all: some 100 bytes each."""

_VERSIONS = (
    """
CREATE TABLE rig (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trial (
    sequence INTEGER PRIMARY KEY, trial_id TEXT NOT NULL UNIQUE, digest TEXT NOT NULL,
    state TEXT NOT NULL, error TEXT NOT NULL, sentence TEXT NOT NULL, noted_at TEXT NOT NULL
);
CREATE TABLE frame (sequence INTEGER PRIMARY KEY, data BLOB NOT NULL);
""",
)

_log = logging.getLogger(__name__)


class LedgerEntry(NamedTuple):
    """One trial as a ledger knows it.

    Attributes:
        digest: Tells its request from any other under the same id.
        state: How far it came.
        frame: Its record, once it has ended; None too if the record was let go.
        error: Kind of error, where the rig's own program failed in it.
        sentence: The error's message.
    """

    digest: str
    state: TrialState
    frame: bytes | None = None
    error: str = ""
    sentence: str = ""


NOTHING = LedgerEntry("", TrialState.UNKNOWN)
"""A trial that was never heard of."""


class Ledger(Protocol):
    """What the rig's server needs of a ledger. Any thread may call."""

    @property
    def identity(self) -> str:
        """Tells this ledger from any other; lasts as long as it does."""
        ...

    @property
    def latched(self) -> str:
        """Why the emergency stop was called; empty if it was not, or was cleared."""
        ...

    def find(self, trial_id: str) -> LedgerEntry:
        """What is known of a trial. Never waits for the disk to write."""
        ...

    def note(self, trial_id: str, digest: str, *events: TrialEvent) -> TrialState:
        """Notes what happens to a trial; returns once it would survive a power cut.

        Returns:
            Its state now.

        Raises:
            RigError: it cannot be written; nothing is noted.
            ProtocolError: that cannot happen to this trial; nothing is noted.
        """
        ...

    def end(self, trial_id: str, outcome: bytes | EstuneError) -> None:
        """Notes how a trial ended: its frame, or what the rig's program raised. Does not fail.

        What cannot be written now is kept in memory, found, and written before the next trial.
        """
        ...

    def latch(self, reason: str) -> None:
        """Notes an emergency stop, or with an empty reason the end of one. Does not fail."""
        ...

    def close(self) -> None:
        """Lets go of the file, if any."""
        ...


class MemoryLedger:
    """A ledger that dies with its process: for simulated rigs, where nothing can be hurt."""

    def __init__(
        self, frames_max_bytes: int = MEMORY_MAX_BYTES, trials_max: int = TRIALS_MAX
    ) -> None:
        self.identity = secrets.token_hex(8)
        self.latched = ""
        self._frames_max_bytes = frames_max_bytes
        self._trials_max = trials_max
        self._entries: OrderedDict[str, LedgerEntry] = OrderedDict()
        self._framed: deque[str] = deque()
        self._frame_bytes = 0
        self._lock = threading.Lock()

    def find(self, trial_id: str) -> LedgerEntry:
        """What is known of a trial."""
        return self._entries.get(trial_id, NOTHING)

    def note(self, trial_id: str, digest: str, *events: TrialEvent) -> TrialState:
        """Notes what happens to a trial, and returns its state now.

        Raises:
            ProtocolError: that cannot happen to this trial; nothing is noted.
        """
        with self._lock:
            state = reduce(after, events, self.find(trial_id).state)
            if trial_id not in self._entries and len(self._entries) >= self._trials_max:
                # Long ended: one is under way at a time, and it is the youngest.
                self._let_go(oldest := next(iter(self._entries)))
                del self._entries[oldest]
            self._entries[trial_id] = self.find(trial_id)._replace(digest=digest, state=state)
        return state

    def end(self, trial_id: str, outcome: bytes | EstuneError) -> None:
        """Notes how a trial ended; its record, the youngest, is held in any case."""
        with self._lock:
            ended = _ended(self.find(trial_id), outcome)
            self._entries[trial_id] = ended
            if ended.frame is not None:
                self._framed.append(trial_id)
                self._frame_bytes += len(ended.frame)
            while self._frame_bytes > self._frames_max_bytes and len(self._framed) > 1:
                self._let_go(self._framed[0])

    def latch(self, reason: str) -> None:
        """Notes an emergency stop, or with an empty reason the end of one."""
        self.latched = reason

    def close(self) -> None:
        """Nothing is held."""

    def _let_go(self, trial_id: str) -> None:
        entry = self._entries[trial_id]
        if entry.frame is not None:
            self._framed.remove(trial_id)  # always at or near the left end
            self._frame_bytes -= len(entry.frame)
            self._entries[trial_id] = entry._replace(frame=None)


class FileLedger:
    """A ledger on disk, written by one process."""

    def __init__(
        self,
        path: Path,
        rig: str,
        *,
        frames_max_bytes: int = FRAMES_MAX_BYTES,
        trials_max: int = TRIALS_MAX,
    ) -> None:
        """Opens the ledger of a rig, or begins one; ends what an earlier start left unended.

        Args:
            path: The file.
            rig: Name of the rig; a ledger serves no other.
            frames_max_bytes: How much of the youngest trials' records is held.
            trials_max: How many trials are remembered at all.

        Raises:
            RigError: it is that of another rig, held by another process, from a newer version,
                damaged, or cannot be written.
        """
        self._path = path
        self._frames_max_bytes = frames_max_bytes
        self._trials_max = trials_max
        self._writing = threading.Lock()
        self._reading = threading.Lock()
        self._unwritten: dict[str, LedgerEntry] = {}
        with self._explained(), ExitStack() as opened:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = path.with_name(f"{path.name}.lock")
            opened.enter_context(sqlite.lock(lock, f"ledger {path}"))
            self._writer = sqlite.connect(opened, path, "rwc")
            self._prepare(rig)
            self._reader = sqlite.connect(opened, path, "rw")
            self._file = sqlite.inode(path)
            self._opened = opened.pop_all()
        facts = dict(self._writer.execute("SELECT key, value FROM rig"))
        self.identity: str = facts["identity"]
        self.latched: str = facts["latched"]
        self._latch_written = True
        self._frame_bytes = self._count()

    def find(self, trial_id: str) -> LedgerEntry:
        """What is known of a trial. Never waits for the disk to write.

        Raises:
            RigError: the file cannot be read.
        """
        if (unwritten := self._unwritten.get(trial_id)) is not None:
            return unwritten
        with self._reading, self._explained():
            row = self._reader.execute(
                "SELECT digest, state, data, error, sentence FROM trial LEFT JOIN frame"
                " USING (sequence) WHERE trial_id=?",
                (trial_id,),
            ).fetchone()
        if row is None:
            return NOTHING
        digest, state, frame, error, sentence = row
        return LedgerEntry(digest, TrialState(state), frame, error, sentence)

    def note(self, trial_id: str, digest: str, *events: TrialEvent) -> TrialState:
        """Notes what happens to a trial; returns once it would survive a power cut.

        Returns:
            Its state now.

        Raises:
            RigError: it cannot be written, or is not where it was; nothing is noted.
            ProtocolError: that cannot happen to this trial; nothing is noted.
        """
        with self._writing:
            self._check_there()
            found = self.find(trial_id)
            state = reduce(after, events, found.state)
            with self._transaction():
                self._write_unwritten()
                self._write(trial_id, found._replace(digest=digest, state=state, frame=None))
            self._unwritten.clear()
            self._latch_written = True
        return state

    def end(self, trial_id: str, outcome: bytes | EstuneError) -> None:
        """Notes how a trial ended. What cannot be written now is written before the next trial."""
        with self._writing:
            self._unwritten[trial_id] = _ended(self.find(trial_id), outcome)
            self._try_to_write()

    def latch(self, reason: str) -> None:
        """Notes an emergency stop, or with an empty reason the end of one."""
        with self._writing:
            self.latched = reason
            self._latch_written = False
            self._try_to_write()

    def close(self) -> None:
        """Lets go of the file."""
        with self._writing, self._reading:
            self._opened.close()

    def _check_there(self) -> None:
        """Refuses to go on in a file that nobody would find again."""
        if sqlite.inode(self._path) != self._file:
            raise RigError(
                f"the rig's ledger {self._path} was deleted or replaced while it was in use: what "
                "trials have run would be forgotten; put it back from a copy, or see to the rig "
                "and begin a new one, and start the rig again"
            )

    def _try_to_write(self) -> None:
        try:
            with self._transaction():
                self._write_unwritten()
        except RigError as error:
            _log.error("kept in memory until it can be written: %s", error)
        else:
            self._unwritten.clear()
            self._latch_written = True

    def _write_unwritten(self) -> None:
        for trial_id, entry in self._unwritten.items():
            self._write(trial_id, entry)
        if not self._latch_written:
            self._writer.execute("UPDATE rig SET value=? WHERE key='latched'", (self.latched,))

    def _write(self, trial_id: str, entry: LedgerEntry) -> None:
        (sequence,) = self._writer.execute(
            "INSERT INTO trial (trial_id, digest, state, error, sentence, noted_at)"
            " VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (trial_id) DO UPDATE SET state=excluded.state,"
            " error=excluded.error, sentence=excluded.sentence RETURNING sequence",
            (trial_id, entry.digest, entry.state.value, entry.error, entry.sentence, _now()),
        ).fetchone()
        if entry.frame is not None:
            self._writer.execute("INSERT INTO frame VALUES (?, ?)", (sequence, entry.frame))
            self._frame_bytes += len(entry.frame)
        self._make_room(sequence)

    def _make_room(self, youngest: int) -> None:
        """Lets go of the oldest frames, and at last of the oldest trials."""
        while self._frame_bytes > self._frames_max_bytes:
            oldest = self._writer.execute(
                "SELECT sequence, length(data) FROM frame WHERE sequence < ?"
                " ORDER BY sequence LIMIT 1",
                (youngest,),
            ).fetchone()
            if oldest is None:
                break
            self._writer.execute("DELETE FROM frame WHERE sequence=?", oldest[:1])
            self._frame_bytes -= oldest[1]
        self._writer.execute(
            "DELETE FROM trial WHERE sequence <= ? AND sequence NOT IN"
            " (SELECT sequence FROM frame)",
            (youngest - self._trials_max,),
        )

    def _count(self) -> int:
        (total,) = self._writer.execute(
            "SELECT coalesce(sum(length(data)), 0) FROM frame"
        ).fetchone()
        return int(total)

    def _prepare(self, rig: str) -> None:
        """Makes the tables, or checks whose they are and ends what was left unended."""
        self._writer.execute("PRAGMA journal_mode=WAL")
        with sqlite.transaction(self._writer):
            if sqlite.version(self._writer) == 0:
                sqlite.migrate(self._writer, _VERSIONS)
                facts = (("name", rig), ("identity", secrets.token_hex(8)), ("latched", ""))
                self._writer.executemany("INSERT INTO rig VALUES (?, ?)", facts)
                return
            sqlite.check_version(self._writer, self._path, len(_VERSIONS), "a ledger")
            sqlite.check_whole(self._writer, self._path)
            (name,) = self._writer.execute("SELECT value FROM rig WHERE key='name'").fetchone()
            if name != rig:
                raise RigError(
                    f"ledger {self._path} is that of rig {name!r}, not of {rig!r}; "
                    "name another file, or the rig as it was"
                )
            sqlite.migrate(self._writer, _VERSIONS)
            self._boot()

    def _boot(self) -> None:
        for state in (TrialState.ACCEPTED, TrialState.RUNNING):
            rows = self._writer.execute(
                "UPDATE trial SET state=? WHERE state=? RETURNING trial_id",
                (after(state, TrialEvent.BOOT).value, state.value),
            ).fetchall()
            for (trial_id,) in rows:
                _log.warning("trial %s: %s", trial_id, after(state, TrialEvent.BOOT).value)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._explained():
            try:
                with sqlite.transaction(self._writer):
                    yield
            except BaseException:
                self._frame_bytes = self._count()
                raise

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns what SQLite and the file system say into what is wrong with the rig."""
        try:
            with sqlite.explained(self._path, "start the rig again"):
                yield
        except JournalError as error:
            raise RigError(f"the rig's ledger: {error}") from error


def _ended(entry: LedgerEntry, outcome: bytes | EstuneError) -> LedgerEntry:
    if isinstance(outcome, bytes):
        return LedgerEntry(entry.digest, after(entry.state, TrialEvent.END), outcome)
    failed = after(entry.state, TrialEvent.FAIL)
    return LedgerEntry(entry.digest, failed, None, type(outcome).__name__, str(outcome))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
