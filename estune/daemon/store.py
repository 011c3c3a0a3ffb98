"""What a daemon must not forget of one rig: one SQLite file in the rig's own folder.

The original gains are in it before the first write to the rig, the gains that are meant to be live
before they are. Each change of the supervision's state is committed together with the event that
tells of it and the command that asked for it. How the file is opened, locked and synchronised is
`estune.support.sqlite`'s.
"""

import json
import secrets
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, Self

from estune.core.control_chart import ChartSignal
from estune.core.gains import Gains
from estune.daemon.events import Event, EventKind
from estune.daemon.supervisor_state import GainSet, Goal, Link, Shutdown, SupervisorState
from estune.errors import JournalError
from estune.support import sqlite
from estune.trial import TrialRecord, TrialRequest, record_frame

FILE_NAME = "daemon.sqlite"
LOCK_NAME = "daemon.lock"
RUNS = "runs"

RECORDS_KEPT = 200
"""Records of so many of the youngest check trials are kept."""
ROWS_KEPT = 20_000
"""So many of the youngest events, commands and check trials are kept."""

VERSIONS = (
    """
CREATE TABLE fact (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE gain_set (
    number INTEGER PRIMARY KEY, at TEXT NOT NULL, name TEXT NOT NULL, P REAL NOT NULL,
    I REAL NOT NULL, D REAL NOT NULL, setpoint_filter_s REAL NOT NULL, why TEXT NOT NULL
);
CREATE TABLE event (
    number INTEGER PRIMARY KEY, at TEXT NOT NULL, kind TEXT NOT NULL, sentence TEXT NOT NULL,
    facts TEXT NOT NULL
);
CREATE TABLE command (
    number INTEGER PRIMARY KEY, command_id TEXT NOT NULL UNIQUE, at TEXT NOT NULL,
    verb TEXT NOT NULL, who TEXT NOT NULL, done INTEGER NOT NULL, sentence TEXT NOT NULL
);
CREATE TABLE check_trial (
    number INTEGER NOT NULL, attempt INTEGER NOT NULL, asked_at TEXT NOT NULL, outcome TEXT,
    cost REAL, sign TEXT, told_at TEXT, PRIMARY KEY (number, attempt)
) WITHOUT ROWID;
CREATE TABLE check_record (number INTEGER PRIMARY KEY, record BLOB NOT NULL)
""",
    """
UPDATE fact SET value = json_remove(value, '$.wanted') WHERE key = 'life'
""",
)
"""What makes each schema out of the one before it; the first makes it out of nothing."""


class CommandResult(NamedTuple):
    """What became of a command.

    Attributes:
        done: Whether it was carried out.
        sentence: What was done, or why not.
    """

    done: bool
    sentence: str


class Check(NamedTuple):
    """A check trial as it is kept.

    Attributes:
        number: Its place among them, from 0.
        attempt: How often it had been void before.
        told_at: When its record came; empty if it has not.
        outcome: How it ended; empty if it has not.
        cost: Its cost, if it has one.
        sign: What the chart said to it.
    """

    number: int
    attempt: int
    told_at: str
    outcome: str
    cost: float | None
    sign: str


class DaemonStore:
    """The file of one rig, open for one process; any of its threads may call."""

    def __init__(
        self, folder: Path, rig: str, connection: sqlite3.Connection, opened: ExitStack
    ) -> None:
        self.folder = folder
        self.rig = rig
        self._connection = connection
        self._opened = opened
        self._lock = threading.RLock()

    @classmethod
    def open(cls, folder: Path, rig: str) -> Self:
        """Opens the store of a rig, or begins one.

        Raises:
            JournalError: another process holds it, it is another rig's, from a newer version,
                damaged, or cannot be written.
        """
        path = folder / FILE_NAME
        with _explained(folder), ExitStack() as opened:
            folder.mkdir(parents=True, exist_ok=True)
            opened.enter_context(
                sqlite.lock(folder / LOCK_NAME, f"the state of rig {rig} in {folder}")
            )
            connection = sqlite.connect(opened, path, "rwc")
            fresh = sqlite.version(connection) == 0
            if not fresh:
                sqlite.check_version(connection, path, len(VERSIONS), "a daemon's file")
                sqlite.check_whole(connection, path)
            connection.execute("PRAGMA journal_mode=WAL")
            with sqlite.transaction(connection):
                sqlite.migrate(connection, VERSIONS)
            store = cls(folder, rig, connection, opened.pop_all())
        try:
            store._check_rig(fresh=fresh)
        except BaseException:
            store.close()
            raise
        return store

    def _check_rig(self, *, fresh: bool) -> None:
        if fresh:
            with self.writing():
                self.put("rig", self.rig)
                self.put("identity", secrets.token_hex(3))
        elif self.fact("rig") != self.rig:
            raise JournalError(
                f"{self.folder / FILE_NAME} is that of rig {self.fact('rig')!r}, not of "
                f"{self.rig!r}; give each rig a folder of its own"
            )

    @property
    def identity(self) -> str:
        """Tells this store from any other; part of the names of its trials."""
        return str(self.fact("identity"))

    @contextmanager
    def writing(self) -> Iterator[None]:
        """All that is written in the block is committed at its end, or nothing of it.

        Raises:
            JournalError: it cannot be written; nothing was.
        """
        with self._lock, _explained(self.folder):
            if self._connection.in_transaction:  # part of a larger block
                yield
            else:
                with sqlite.transaction(self._connection):
                    yield

    def fact(self, key: str) -> Any:
        """What is noted under a key, or None."""
        rows = self._rows("SELECT value FROM fact WHERE key=?", key)
        return json.loads(rows[0][0]) if rows else None

    def put(self, key: str, value: Any) -> None:
        """Notes a JSON value under a key."""
        self._write("INSERT OR REPLACE INTO fact VALUES (?, ?)", key, json.dumps(value))

    @property
    def life(self) -> SupervisorState:
        """Where the supervision stands."""
        kept = self.fact("life")
        if kept is None:
            return SupervisorState()
        return SupervisorState(
            **{
                **kept,
                "goal": Goal(kept["goal"]),
                "home": GainSet(kept["home"]),
                "link": Link(kept["link"]),
                "ending": Shutdown(kept["ending"]),
            }
        )

    @life.setter
    def life(self, life: SupervisorState) -> None:
        self.put("life", asdict(life))

    def gains(self) -> dict[GainSet, Gains]:
        """The gain sets that there are; a candidate that was decided on is none any more."""
        kept = self.fact("gains") or {}
        return {GainSet(name): Gains(**values) for name, values in kept.items()}

    def set_gains(self, name: GainSet, gains: Gains | None, why: str = "") -> None:
        """Notes a gain set, or that there is none any more; the earlier one stays in history."""
        kept = self.gains()
        kept.pop(name, None)
        if gains is not None:
            kept[name] = gains
            self._write(
                "INSERT INTO gain_set (at, name, P, I, D, setpoint_filter_s, why)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                *(now(), name.value, *gains.as_tuple(), why),
            )
        self.put("gains", {name.value: asdict(gains) for name, gains in kept.items()})

    def all_gain_sets(self) -> set[Gains]:
        """All gains that were ever original, candidate or accepted."""
        return {
            Gains(*row)
            for row in self._rows("SELECT DISTINCT P, I, D, setpoint_filter_s FROM gain_set")
        }

    def why(self, name: GainSet) -> str:
        """Why a gain set is what it was last; empty if there never was one."""
        rows = self._rows(
            "SELECT why FROM gain_set WHERE name=? ORDER BY number DESC LIMIT 1", name.value
        )
        return str(rows[0][0]) if rows else ""

    def gain_history(self, limit: int) -> list[dict[str, Any]]:
        """The youngest gain sets, oldest first."""
        names = ("at", "name", "P", "I", "D", "setpoint_filter_s", "why")
        return self._youngest("gain_set", names, limit)

    def note(self, kind: EventKind, sentence: str, facts: dict[str, object]) -> Event:
        """Notes an event."""
        at = now()
        number = self._write(
            "INSERT INTO event (at, kind, sentence, facts) VALUES (?, ?, ?, ?)",
            *(at, kind.value, sentence, json.dumps(facts)),
        )
        self._write("DELETE FROM event WHERE number <= ?", number - ROWS_KEPT)
        return Event(self.rig, number, at, kind, sentence, facts)

    def events(self, after: int, limit: int) -> list[Event]:
        """Events after one of that number, oldest first; after a negative one the youngest."""
        columns = "SELECT number, at, kind, sentence, facts FROM event"
        if after < 0:
            rows = self._rows(f"{columns} ORDER BY number DESC LIMIT ?", limit)[::-1]
        else:
            rows = self._rows(f"{columns} WHERE number > ? ORDER BY number LIMIT ?", after, limit)
        return [
            Event(self.rig, number, at, EventKind(kind), sentence, json.loads(facts))
            for number, at, kind, sentence, facts in rows
        ]

    def command(self, command_id: str) -> CommandResult | None:
        """What became of a command, if it came before."""
        rows = self._rows("SELECT done, sentence FROM command WHERE command_id=?", command_id)
        return CommandResult(bool(rows[0][0]), rows[0][1]) if rows else None

    def note_command(self, command_id: str, verb: str, who: str, done: CommandResult) -> None:
        """Notes a command and what became of it."""
        number = self._write(
            "INSERT INTO command (command_id, at, verb, who, done, sentence)"
            " VALUES (?, ?, ?, ?, ?, ?)",
            *(command_id, now(), verb, who, int(done.done), done.sentence),
        )
        self._write("DELETE FROM command WHERE number <= ?", number - ROWS_KEPT)

    def commands(self, limit: int) -> list[dict[str, Any]]:
        """The youngest commands, oldest first."""
        return self._youngest("command", ("at", "verb", "who", "done", "sentence"), limit)

    def next_check(self) -> tuple[int, int]:
        """Number and attempt of the check trial to be asked for: one that was not told, first."""
        rows = self._rows(
            "SELECT number, attempt, outcome, sign FROM check_trial"
            " ORDER BY number DESC, attempt DESC LIMIT 1"
        )
        if not rows:
            return 0, 0
        number, attempt, outcome, sign = rows[0]
        if outcome is None:
            return number, attempt
        return (number, attempt + 1) if sign is None else (number + 1, 0)

    def ask_check(self, request: TrialRequest) -> None:
        """Notes a check trial before it is asked for."""
        self._write(
            "INSERT OR IGNORE INTO check_trial (number, attempt, asked_at) VALUES (?, ?, ?)",
            *(request.number, request.attempt, now()),
        )

    def tell_check(
        self, request: TrialRequest, record: TrialRecord, cost: float, sign: ChartSignal | None
    ) -> None:
        """Notes how a check trial ended; without a sign it was void and is asked for again."""
        number = request.number
        with self.writing():
            self._write(
                "UPDATE check_trial SET outcome=?, cost=?, sign=?, told_at=?"
                " WHERE number=? AND attempt=?",
                *(record.outcome.value, cost, sign and sign.value, now(), number, request.attempt),
            )
            if sign is not None:
                # In a table of its own, so that what is let go of leaves no holes among the rows.
                data = record_frame.encode(record)
                self._write("INSERT OR REPLACE INTO check_record VALUES (?, ?)", number, data)
            self._write("DELETE FROM check_record WHERE number <= ?", number - RECORDS_KEPT)
            self._write("DELETE FROM check_trial WHERE number <= ?", number - ROWS_KEPT)

    def check_record(self, number: int) -> TrialRecord:
        """The record of a check trial, which is kept for a while.

        Raises:
            JournalError: it is not, or no longer, there.
        """
        rows = self._rows("SELECT record FROM check_record WHERE number=?", number)
        if not rows:
            raise JournalError(
                f"{self.folder / FILE_NAME} holds no record of check trial {number}; the "
                f"{RECORDS_KEPT} youngest are kept"
            )
        return record_frame.decode(rows[0][0])

    def checks(self, limit: int) -> list[Check]:
        """The youngest check trials, oldest first."""
        rows = self._rows(
            "SELECT number, attempt, coalesce(told_at, ''), coalesce(outcome, ''), cost,"
            " coalesce(sign, '') FROM check_trial ORDER BY number DESC, attempt DESC LIMIT ?",
            limit,
        )
        return [Check(*row) for row in rows[::-1]]

    def close(self) -> None:
        """Lets go of the file."""
        with self._lock:
            self._opened.close()

    def _youngest(self, table: str, names: tuple[str, ...], limit: int) -> list[dict[str, Any]]:
        rows = self._rows(
            f"SELECT {', '.join(names)} FROM {table} ORDER BY number DESC LIMIT ?",  # noqa: S608  our own names
            limit,
        )
        return [dict(zip(names, row, strict=True)) for row in rows[::-1]]

    def _rows(self, statement: str, *values: Any) -> list[Any]:
        with self._lock, _explained(self.folder):
            return self._connection.execute(statement, values).fetchall()

    def _write(self, statement: str, *values: Any) -> int:
        """Writes, in the block that is open or in one of its own; the row's number."""
        with self.writing():
            return self._connection.execute(statement, values).lastrowid or 0


def now() -> str:
    """The time of day, ISO 8601 with offset."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _explained(folder: Path) -> Any:
    return sqlite.explained(folder / FILE_NAME, "the daemon goes on by itself")
