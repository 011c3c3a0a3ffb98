"""Ledger of a rig: the state of every trial id ever submitted, so that no trial runs twice.

On a rig that moves, it is a file (`estune.support.sqlite`), so that an entry survives kill -9 and
power loss. A trial is noted as accepted before its sender has a reply, as running before anything
moves, and with its record once the live gains are restored. At the start of the rig, an accepted
trial becomes never started and a running one interrupted. The emergency stop is noted as well, and
the gains that ran before daemons that share the rig set others.

Frames of the oldest trials are deleted first; their ids are remembered far longer.
"""

import json
import logging
import secrets
import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import NamedTuple

from estune.core.gains import Gains
from estune.errors import EstuneError, JournalError, RigError
from estune.remote.state_machine.trials import TrialEvent, TrialState, after
from estune.support.sqlite import FileKind, SqliteFile

FRAMES_MAX_BYTES = 64 * 2**20
"""Limit of the frames of a ledger on disk."""

MEMORY_MAX_BYTES = 8 * 2**20
"""Limit of the frames of a ledger in memory."""

TRIALS_MAX = 1_000_000
"""Limit of the number of trials in a ledger, about 100 bytes each."""

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
LEDGER = FileKind("a ledger", _VERSIONS, "restart the rig")
"""Kind of the file."""

_log = logging.getLogger(__name__)


class LedgerEntry(NamedTuple):
    """Entry of one trial.

    Attributes:
        frame: Its record, once it has ended; None too if the record was deleted.
        error: Kind of error, where the rig's program failed in it.
    """

    digest: str
    state: TrialState
    frame: bytes | None = None
    error: str = ""
    sentence: str = ""

    def ended(self, outcome: bytes | EstuneError) -> "LedgerEntry":
        """The entry after the end of the trial."""
        if isinstance(outcome, bytes):
            return LedgerEntry(self.digest, after(self.state, TrialEvent.END), outcome)
        failed = after(self.state, TrialEvent.FAIL)
        return LedgerEntry(self.digest, failed, None, type(outcome).__name__, str(outcome))


NOTHING = LedgerEntry("", TrialState.UNKNOWN)
"""The entry of a trial that was never submitted."""


class _RigFacts:
    """What a ledger holds of the rig itself, beside its trials."""

    def __init__(self, facts: dict[str, str]) -> None:
        self._facts = facts

    @property
    def identity(self) -> str:
        """Random identity, as durable as the ledger itself."""
        return self._facts["identity"]

    @property
    def latched(self) -> str:
        """Reason of the emergency stop; empty if there was none, or it was cleared."""
        return self._facts["latched"]

    def latch(self, reason: str) -> None:
        """Notes an emergency stop, or with an empty reason its reset. Does not fail."""
        self._set_fact("latched", reason)

    def keep_original(self, live: Gains, original: Gains | None) -> None:
        """Notes the gains that ran before those that are live now, if they are known.

        Does not fail.
        """
        # Gains set without an original end what was noted: it belonged to the gains before them.
        if original is not None or self._facts.get("original"):
            noted = None if original is None else [live.as_tuple(), original.as_tuple()]
            self._set_fact("original", json.dumps(noted))

    def original_of(self, live: Gains) -> Gains | None:
        """The gains that were noted when these became the live ones, if any were."""
        # Only while those gains still run: somebody may have set others at the rig itself.
        noted = json.loads(self._facts.get("original") or "null")
        return Gains(*noted[1]) if noted and live == Gains(*noted[0]) else None

    def _set_fact(self, key: str, value: str) -> None:
        self._facts[key] = value


class MemoryLedger(_RigFacts):
    """Ledger that lasts as long as its process: for simulated rigs."""

    def __init__(
        self, frames_max_bytes: int = MEMORY_MAX_BYTES, trials_max: int = TRIALS_MAX
    ) -> None:
        super().__init__({"identity": secrets.token_hex(8), "latched": ""})
        self._frames_max_bytes = frames_max_bytes
        self._trials_max = trials_max
        self._entries: OrderedDict[str, LedgerEntry] = OrderedDict()
        self._framed: deque[str] = deque()
        self._frame_bytes = 0
        self._lock = threading.Lock()

    def find(self, trial_id: str) -> LedgerEntry:
        """Entry of a trial."""
        return self._entries.get(trial_id, NOTHING)

    @property
    def last(self) -> str:
        """The youngest trial; empty without any."""
        with self._lock:
            return next(reversed(self._entries), "")

    def note(self, trial_id: str, digest: str, *events: TrialEvent) -> TrialState:
        """Applies events to a trial, and returns its state.

        Raises:
            ProtocolError: an event is impossible for this trial; nothing is noted.
        """
        with self._lock:
            state = reduce(after, events, self.find(trial_id).state)
            if trial_id not in self._entries and len(self._entries) >= self._trials_max:
                # Long ended: one is active at a time, and it is the youngest.
                self._drop_frame(oldest := next(iter(self._entries)))
                del self._entries[oldest]
            self._entries[trial_id] = self.find(trial_id)._replace(digest=digest, state=state)
        return state

    def end(self, trial_id: str, outcome: bytes | EstuneError) -> None:
        """Notes the end of a trial; the youngest record is kept whatever its size."""
        with self._lock:
            ended = self.find(trial_id).ended(outcome)
            self._entries[trial_id] = ended
            if ended.frame is not None:
                self._framed.append(trial_id)
                self._frame_bytes += len(ended.frame)
            while self._frame_bytes > self._frames_max_bytes and len(self._framed) > 1:
                self._drop_frame(self._framed[0])

    def close(self) -> None:
        """Does nothing."""

    def _drop_frame(self, trial_id: str) -> None:
        entry = self._entries[trial_id]
        if entry.frame is not None:
            self._framed.remove(trial_id)  # always at or near the left end
            self._frame_bytes -= len(entry.frame)
            self._entries[trial_id] = entry._replace(frame=None)


class FileLedger(_RigFacts):
    """Ledger on disk, written by one process."""

    def __init__(
        self,
        path: Path,
        rig: str,
        *,
        frames_max_bytes: int = FRAMES_MAX_BYTES,
        trials_max: int = TRIALS_MAX,
    ) -> None:
        """Opens or creates the ledger of a rig; ends the trials that an earlier start left open.

        Args:
            rig: Name of the rig; a ledger serves no other.
            frames_max_bytes: Limit of the frames of the youngest trials.
            trials_max: Limit of the number of trials.

        Raises:
            RigError: it is that of another rig, in use by another process, from a newer version,
                damaged, or cannot be written.
        """
        self._frames_max_bytes = frames_max_bytes
        self._trials_max = trials_max
        self._writing = threading.Lock()
        self._unwritten: dict[str, LedgerEntry] = {}
        with _as_rig_error(), ExitStack() as opened:
            self._file = opened.enter_context(
                SqliteFile.open_writer(path, LEDGER, prepare=lambda file: _prepare(file, rig))
            )
            self._reader = opened.enter_context(SqliteFile.open_reader(path, LEDGER))
            super().__init__(dict(self._file.rows("SELECT key, value FROM rig")))
            self._frame_bytes = self._count()
            self._opened = opened.pop_all()
        self._unwritten_facts: set[str] = set()

    def find(self, trial_id: str) -> LedgerEntry:
        """Entry of a trial. Never waits for a write to the disk."""
        if (unwritten := self._unwritten.get(trial_id)) is not None:
            return unwritten
        with _as_rig_error():
            rows = self._reader.rows(
                "SELECT digest, state, data, error, sentence FROM trial LEFT JOIN frame"
                " USING (sequence) WHERE trial_id=?",
                trial_id,
            )
        if not rows:
            return NOTHING
        digest, state, frame, error, sentence = rows[0]
        # A deleted frame is None, and the state stays ENDED: the id never runs again.
        return LedgerEntry(digest, TrialState(state), frame, error, sentence)

    @property
    def last(self) -> str:
        """The youngest trial; empty without any, or while the file cannot be read."""
        with suppress(RigError), _as_rig_error():
            newest = "SELECT trial_id FROM trial ORDER BY sequence DESC LIMIT 1"
            for (trial_id,) in self._reader.rows(newest):
                return str(trial_id)
        return ""

    def note(self, trial_id: str, digest: str, *events: TrialEvent) -> TrialState:
        """Applies events to a trial; returns its state once it would survive a power cut.

        Raises:
            RigError: it cannot be written, or the file was replaced; nothing is noted.
            ProtocolError: an event is impossible for this trial; nothing is noted.
        """
        with self._writing:
            # Entries written to a deleted file are lost at the next start, and trials run again.
            if not self._file.is_in_place():
                raise RigError(
                    f"the rig's ledger {self._file.path} was deleted or replaced while it was in "
                    "use, and with it the ids of the trials that have run; restore it from a "
                    "copy, or inspect the rig and begin a new one, and restart the rig"
                )
            entry = self.find(trial_id)
            state = reduce(after, events, entry.state)
            self._write_all((trial_id, entry._replace(digest=digest, state=state, frame=None)))
        return state

    def end(self, trial_id: str, outcome: bytes | EstuneError) -> None:
        """Notes the end of a trial: its frame, or the error of the rig's program. Does not fail.

        What cannot be written now is kept in memory, and written before the next trial.
        """
        # The trial has run: with an error from a full disk its record would be lost, too.
        with self._writing:
            self._unwritten[trial_id] = self.find(trial_id).ended(outcome)
            self._try_to_write()

    def close(self) -> None:
        """Releases the file."""
        with self._writing:
            self._opened.close()

    def _set_fact(self, key: str, value: str) -> None:
        with self._writing:
            super()._set_fact(key, value)
            self._unwritten_facts.add(key)
            self._try_to_write()

    def _try_to_write(self) -> None:
        try:
            self._write_all()
        except RigError as error:
            _log.error("kept in memory until it can be written: %s", error)

    def _write_all(self, *entries: tuple[str, LedgerEntry]) -> None:
        """Writes what is still unwritten, and more entries: all or nothing."""
        with _as_rig_error():
            try:
                with self._file.transaction():
                    for trial_id, entry in (*self._unwritten.items(), *entries):
                        self._write(trial_id, entry)
                    for key in self._unwritten_facts:
                        change = "INSERT OR REPLACE INTO rig VALUES (?, ?)"
                        self._file.write(change, key, self._facts[key])
            except BaseException:
                # What was rolled back had been counted, and good frames would be deleted for it.
                self._frame_bytes = self._count()
                raise
        self._unwritten.clear()
        self._unwritten_facts.clear()

    def _write(self, trial_id: str, entry: LedgerEntry) -> None:
        ((sequence,),) = self._file.rows(
            "INSERT INTO trial (trial_id, digest, state, error, sentence, noted_at)"
            " VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (trial_id) DO UPDATE SET state=excluded.state,"
            " error=excluded.error, sentence=excluded.sentence RETURNING sequence",
            *(trial_id, entry.digest, entry.state.value, entry.error, entry.sentence),
            datetime.now(UTC).isoformat(timespec="milliseconds"),
        )
        if entry.frame is not None:
            self._file.write("INSERT INTO frame VALUES (?, ?)", sequence, entry.frame)
            self._frame_bytes += len(entry.frame)
        self._make_room(sequence)

    def _make_room(self, youngest: int) -> None:
        while self._frame_bytes > self._frames_max_bytes:
            oldest = self._file.rows(
                "SELECT sequence, length(data) FROM frame WHERE sequence < ?"
                " ORDER BY sequence LIMIT 1",
                youngest,
            )
            if not oldest:
                break
            sequence, size = oldest[0]
            self._file.write("DELETE FROM frame WHERE sequence=?", sequence)
            self._frame_bytes -= size
        self._file.write(
            "DELETE FROM trial WHERE sequence <= ? AND sequence NOT IN"
            " (SELECT sequence FROM frame)",
            youngest - self._trials_max,
        )

    def _count(self) -> int:
        ((total,),) = self._file.rows("SELECT coalesce(sum(length(data)), 0) FROM frame")
        return int(total)


Ledger = MemoryLedger | FileLedger
"""A ledger. Any thread may call."""


def _prepare(file: SqliteFile, rig: str) -> None:
    if file.is_new:
        facts = (("name", rig), ("identity", secrets.token_hex(8)), ("latched", ""))
        file.write_many("INSERT INTO rig VALUES (?, ?)", facts)
        return
    ((name,),) = file.rows("SELECT value FROM rig WHERE key='name'")
    # Ids of another rig would answer for trials that this one never ran.
    if name != rig:
        raise RigError(
            f"ledger {file.path} is that of rig {name!r}, not of {rig!r}; "
            "choose another file, or the rig's former name"
        )
    # A trial whose process has died can no longer end: its client would wait for it for ever.
    for state in (TrialState.ACCEPTED, TrialState.RUNNING):
        booted = after(state, TrialEvent.BOOT).value
        for (trial_id,) in file.rows(
            "UPDATE trial SET state=? WHERE state=? RETURNING trial_id", booted, state.value
        ):
            _log.warning("trial %s: %s", trial_id, booted)


@contextmanager
def _as_rig_error() -> Iterator[None]:
    """Converts an error of the file into one of the rig."""
    try:
        yield
    except JournalError as error:
        raise RigError(f"the rig's ledger: {error}") from error
