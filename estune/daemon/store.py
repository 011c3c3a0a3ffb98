"""State of one rig's supervision that outlives the daemon: one SQLite file in the rig's folder.

The original gains are in it before the first write to the rig, and the nominal gains before they
are live. A change of the supervisor state is committed together with its event and its command.
"""

import json
import secrets
from contextlib import AbstractContextManager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, Self

from estune.core.control_chart import ChartSignal
from estune.core.gains import Gains
from estune.daemon.events import EventKind
from estune.daemon.faults import EventFacts
from estune.daemon.supervisor_state import GainSet, Goal, RigLink, Shutdown, SupervisorState
from estune.errors import JournalError, RigError
from estune.remote.messages.daemon import DaemonEvent
from estune.run.submitted_trial import SubmittedTrial
from estune.support.sqlite import FileKind, SqliteFile, has_writer
from estune.trial import TrialRecord, TrialRequest, record_frame

FILE_NAME = "daemon.sqlite"
RUNS = "runs"

RECORDS_KEPT = 200
"""Number of newest check trials whose records are kept."""
ROWS_KEPT = 20_000
"""Number of newest events, commands and check trials that are kept."""

_VERSIONS = (
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
    cost REAL, sign TEXT, told_at TEXT, alarm_low REAL, alarm_high REAL,
    PRIMARY KEY (number, attempt)
) WITHOUT ROWID;
CREATE TABLE check_record (number INTEGER PRIMARY KEY, record BLOB NOT NULL)
""",
)
_KIND = FileKind(
    "a daemon's file", _VERSIONS, "the daemon continues by itself", lock_name="daemon.lock"
)


class CommandResult(NamedTuple):
    """Whether a command was carried out, and what was done or why not."""

    done: bool
    sentence: str


class Check(NamedTuple):
    """A check trial as stored.

    Attributes:
        number: Index, from 0.
        attempt: Number of void trials under this index before.
        told_at: Time at which its record arrived; empty before.
        alarm_low: Cost below which it was an outlier; None where that was not stored.
        alarm_high: Cost above which it was an outlier.
    """

    number: int
    attempt: int
    told_at: str
    outcome: str
    cost: float | None
    sign: str
    alarm_low: float | None
    alarm_high: float | None


class DaemonStore:
    """Open file of one rig; any thread of the process may call."""

    def __init__(self, rig: str, file: SqliteFile) -> None:
        self.folder = file.path.parent
        self.rig = rig
        self._file = file
        self.close = file.close

    @classmethod
    def open(cls, folder: Path, rig: str) -> Self:
        """Opens the store of a rig, or creates it.

        Raises:
            RigError: another daemon has it.
            JournalError: it belongs to another rig, is from a newer version, damaged, or cannot
                be written.
        """

        def prepare(file: SqliteFile) -> None:
            store = cls(rig, file)
            if file.is_new:
                store.set_fact("rig", rig)
                store.set_fact("identity", secrets.token_hex(3))
            elif store.fact("rig") != rig:
                raise JournalError(
                    f"{file.path} is that of rig {store.fact('rig')!r}, not of {rig!r}; give each "
                    "rig a folder of its own"
                )

        path = folder / FILE_NAME
        try:
            return cls(rig, SqliteFile.open_writer(path, _KIND, prepare=prepare))
        except JournalError as error:
            if has_writer(path, _KIND):  # no fault of the file: exit code 4, as for a held rig
                raise RigError(f"the state of rig {rig} is in use: {error}") from error
            raise

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The store in a rig's folder, to be read only; its daemon may be running.

        Raises:
            JournalError: there is none, or it cannot be read.
        """
        file = SqliteFile.open_reader(folder / FILE_NAME, _KIND)
        rows = file.rows("SELECT value FROM fact WHERE key='rig'")
        return cls(json.loads(rows[0][0]) if rows else folder.name, file)

    @property
    def changes(self) -> int:
        """Number that differs once anything was written."""
        return self._file.changes

    def transaction(self) -> AbstractContextManager[None]:
        """Commits all that is written in the block at its end, or nothing; blocks nest.

        Raises:
            JournalError: it cannot be written; nothing was.
        """
        return self._file.transaction()

    @property
    def identity(self) -> str:
        """Identifies this store; part of the names of its trials."""
        return str(self.fact("identity"))

    def fact(self, key: str) -> Any:
        """JSON value stored under a key, or None."""
        rows = self._file.rows("SELECT value FROM fact WHERE key=?", key)
        return json.loads(rows[0][0]) if rows else None

    def set_fact(self, key: str, value: Any) -> None:
        """Stores a JSON value under a key."""
        self._file.write("INSERT OR REPLACE INTO fact VALUES (?, ?)", key, json.dumps(value))

    @property
    def state(self) -> SupervisorState:
        """The supervisor state."""
        stored = self.fact("life")
        if stored is None:
            return SupervisorState()
        enums = {"goal": Goal, "home": GainSet, "link": RigLink, "ending": Shutdown}
        return SupervisorState(**stored | {name: of(stored[name]) for name, of in enums.items()})

    @state.setter
    def state(self, state: SupervisorState) -> None:
        self.set_fact("life", asdict(state))

    @property
    def submitted(self) -> SubmittedTrial | None:
        """The trial last submitted to a rig that moves and keeps a ledger; None without one."""
        stored = self.fact("submitted")
        return None if stored is None else SubmittedTrial(*stored)

    @submitted.setter
    def submitted(self, trial: SubmittedTrial | None) -> None:
        self.set_fact("submitted", trial)

    def gains(self) -> dict[GainSet, Gains]:
        """The current gain sets; a candidate only while it awaits a decision."""
        stored = self.fact("gains") or {}
        return {GainSet(name): Gains(**values) for name, values in stored.items()}

    def set_gains(self, name: GainSet, gains: Gains | None, why: str = "") -> None:
        """Stores or removes a gain set; the history keeps the earlier one."""
        sets = self.gains()
        sets.pop(name, None)
        if gains is not None:
            sets[name] = gains
            self._file.write(
                "INSERT INTO gain_set (at, name, P, I, D, setpoint_filter_s, why)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                *(now(), name.value, *gains.as_tuple(), why),
            )
        self.set_fact("gains", {name.value: asdict(gains) for name, gains in sets.items()})

    def all_gain_sets(self) -> set[Gains]:
        """All gains that were ever original, candidate or accepted."""
        rows = self._file.rows("SELECT DISTINCT P, I, D, setpoint_filter_s FROM gain_set")
        return {Gains(*row) for row in rows}

    def why(self, name: GainSet) -> str:
        """Reason for the latest gain set of a name; empty if there never was one."""
        rows = self._file.rows(
            "SELECT why FROM gain_set WHERE name=? ORDER BY number DESC LIMIT 1", name.value
        )
        return str(rows[0][0]) if rows else ""

    def gain_history(self, limit: int) -> list[dict[str, Any]]:
        """The newest gain sets, oldest first."""
        names = ("at", "name", "P", "I", "D", "setpoint_filter_s", "why")
        return self._newest("gain_set", names, limit)

    def add_event(self, kind: EventKind, sentence: str, facts: EventFacts) -> DaemonEvent:
        """Stores an event."""
        at = now()
        number = self._file.write(
            "INSERT INTO event (at, kind, sentence, facts) VALUES (?, ?, ?, ?)",
            *(at, kind.value, sentence, json.dumps(facts)),
        )
        self._file.write("DELETE FROM event WHERE number <= ?", number - ROWS_KEPT)
        return DaemonEvent(self.rig, number, at, kind, sentence, dict(facts))

    def events(self, after: int, limit: int) -> list[DaemonEvent]:
        """Events after a number, oldest first; the newest ones if the number is negative."""
        columns = "SELECT number, at, kind, sentence, facts FROM event"
        if after < 0:
            rows = self._file.rows(f"{columns} ORDER BY number DESC LIMIT ?", limit)[::-1]
        else:
            where = f"{columns} WHERE number > ? ORDER BY number LIMIT ?"
            rows = self._file.rows(where, after, limit)
        return [
            DaemonEvent(self.rig, number, at, kind, sentence, json.loads(facts))
            for number, at, kind, sentence, facts in rows
        ]

    def command(self, command_id: str) -> CommandResult | None:
        """Result of a command that was given before, or None."""
        rows = self._file.rows("SELECT done, sentence FROM command WHERE command_id=?", command_id)
        return CommandResult(bool(rows[0][0]), rows[0][1]) if rows else None

    def add_command(self, command_id: str, verb: str, who: str, result: CommandResult) -> None:
        """Stores a command and its result."""
        number = self._file.write(
            "INSERT INTO command (command_id, at, verb, who, done, sentence)"
            " VALUES (?, ?, ?, ?, ?, ?)",
            *(command_id, now(), verb, who, int(result.done), result.sentence),
        )
        self._file.write("DELETE FROM command WHERE number <= ?", number - ROWS_KEPT)

    def commands(self, limit: int) -> list[dict[str, Any]]:
        """The newest commands, oldest first."""
        return self._newest("command", ("at", "verb", "who", "done", "sentence"), limit)

    def next_check(self) -> tuple[int, int]:
        """Number and attempt of the next check trial; an unanswered one is repeated as it was."""
        rows = self._file.rows(
            "SELECT number, attempt, outcome, sign FROM check_trial"
            " ORDER BY number DESC, attempt DESC LIMIT 1"
        )
        if not rows:
            return 0, 0
        number, attempt, outcome, sign = rows[0]
        if outcome is None:
            return number, attempt
        return (number, attempt + 1) if sign is None else (number + 1, 0)

    def begin_check(self, request: TrialRequest) -> None:
        """Stores a check trial before it is requested from the rig."""
        self._file.write(
            "INSERT OR IGNORE INTO check_trial (number, attempt, asked_at) VALUES (?, ?, ?)",
            *(request.number, request.attempt, now()),
        )

    def finish_check(
        self,
        request: TrialRequest,
        record: TrialRecord,
        cost: float,
        sign: ChartSignal | None,
        alarm: tuple[float, float],
    ) -> None:
        """Stores the result of a check trial, and between which costs it was no outlier.

        Without a signal it was void and is repeated.
        """
        number, attempt = request.number, request.attempt
        with self.transaction():
            self._file.write(
                "UPDATE check_trial SET outcome=?, cost=?, sign=?, told_at=?, alarm_low=?,"
                " alarm_high=? WHERE number=? AND attempt=?",
                *(record.outcome.value, cost, sign and sign.value, now(), *alarm),
                *(number, attempt),
            )
            if sign is not None:
                # In a table of its own, so that deleted records leave no gaps among the rows.
                data = record_frame.encode(record)
                self._file.write("INSERT OR REPLACE INTO check_record VALUES (?, ?)", number, data)
            self._file.write("DELETE FROM check_record WHERE number <= ?", number - RECORDS_KEPT)
            self._file.write("DELETE FROM check_trial WHERE number <= ?", number - ROWS_KEPT)

    def checks(self, limit: int) -> list[Check]:
        """The newest check trials, oldest first."""
        rows = self._file.rows(
            "SELECT number, attempt, coalesce(told_at, ''), coalesce(outcome, ''), cost,"
            " coalesce(sign, ''), alarm_low, alarm_high FROM check_trial"
            " ORDER BY number DESC, attempt DESC LIMIT ?",
            limit,
        )
        return [Check(*row) for row in rows[::-1]]

    def _newest(self, table: str, names: tuple[str, ...], limit: int) -> list[dict[str, Any]]:
        rows = self._file.rows(
            f"SELECT {', '.join(names)} FROM {table} ORDER BY number DESC LIMIT ?",  # noqa: S608  our own names
            limit,
        )
        return [dict(zip(names, row, strict=True)) for row in rows[::-1]]


def now() -> str:
    """The time of day, ISO 8601 with offset."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def age_s(at: str) -> float:
    """Time since, by the time of day; negative if that was set back."""
    return (datetime.now(UTC) - datetime.fromisoformat(at)).total_seconds()
