"""Messages of the daemon: keys, commands, replies; no transport.

::

    reel/v1/<rig>/daemon/alive/<instance>        liveliness; the instance is new at each start
    reel/v1/<rig>/daemon/status                  current state; also published at each change
    reel/v1/<rig>/daemon/history                 gain sets, commands and check trials
    reel/v1/<rig>/daemon/events                  past events; each also published as it occurs
    reel/v1/<rig>/daemon/@cmd/<instance>/<verb>  accept, reject, revert, pause, resume, stop

A command is obeyed only on exactly its own key, never by a wildcard. It has an id, may be repeated
until it is answered, and is executed once.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, get_args

from estune.core.gains import Gains
from estune.remote.messages.codec import HOLDER_MAX, Message
from estune.remote.messages.keys import Keys

DaemonVerb = Literal["accept", "reject", "revert", "pause", "resume", "stop"]
DAEMON_VERBS: tuple[DaemonVerb, ...] = get_args(DaemonVerb)

ANSWER_MAX_BYTES = 2**20
ROWS_MAX = 1000
"""Rows of events or history in one reply."""

ANY_DAEMON = "reel/v1/*/daemon/alive/*"
"""Matches the liveliness tokens of the daemons of all rigs."""

ANY_QUERY = "reel/v1/*/daemon/*"
"""Matches the queries of all rigs, about any topic."""

ANY_STATUS = "reel/v1/*/daemon/status"
"""Matches the query of the status of all rigs."""


@dataclass(frozen=True, slots=True)
class DaemonKeys:
    """The keys of the daemon of one rig."""

    rig: str

    @property
    def root(self) -> str:
        """Common prefix."""
        return f"{Keys(self.rig).root}/daemon"

    def alive(self, instance: str) -> str:
        """Liveliness token of an instance; `*` for any."""
        return f"{self.root}/alive/{instance}"

    def command(self, instance: str, verb: str) -> str:
        """Command to an instance."""
        return f"{self.root}/@cmd/{instance}/{verb}"

    def about(self, topic: Literal["status", "history", "events"]) -> str:
        """Query of a topic."""
        return f"{self.root}/{topic}"


def any_command(instance: str) -> str:
    """Matches the commands of all rigs to an instance."""
    return f"reel/v1/*/daemon/@cmd/{instance}/*"


@dataclass(frozen=True, slots=True)
class Command(Message):
    """Command to the daemon; its verb is in the key.

    Attributes:
        command_id: 16 hexadecimal digits drawn at random, new for each command.
        who: Sender, in words for people.
        why: Reason, in words for people; may be empty.
    """

    command_id: str
    who: str
    why: str = ""

    def __post_init__(self) -> None:
        if len(self.command_id) != 16 or set(self.command_id) - set("0123456789abcdef"):
            raise ValueError(f"command_id {self.command_id!r:.40} is not 16 hexadecimal digits")
        if not 0 < len(self.who) <= HOLDER_MAX or len(self.why) > HOLDER_MAX:
            raise ValueError(f"who and why may have {HOLDER_MAX} characters, and who at least one")


@dataclass(frozen=True, slots=True)
class Request(Message):
    """Query of rows of history or events.

    Attributes:
        after: Only events after this number; below zero the latest.
        limit: Largest number of rows.
    """

    after: int = -1
    limit: int = 50

    def __post_init__(self) -> None:
        if not 1 <= self.limit <= ROWS_MAX:
            raise ValueError(f"limit is {self.limit}; it must be from 1 to {ROWS_MAX}")


@dataclass(frozen=True, slots=True)
class CommandAnswer(Message):
    """Result of a command, or the reason why a query was refused.

    Attributes:
        done: Whether the command is being executed.
        sentence: What is being done, or why not.
    """

    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES
    done: bool
    sentence: str


class Report(Message):
    """Base of the daemon's reports, in which a cost may be NaN."""

    __slots__ = ()
    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}
    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES


@dataclass(frozen=True, slots=True)
class DaemonStatus(Report):
    """State of the supervision of one rig, and its live gains.

    Attributes:
        rig: The rig.
        instance: Start of the daemon that replies.
        mode: Current mode.
        sentence: The mode in words.
        paused: Reason of a pause; empty if not paused.
        trouble: Last failure; empty once it is over.
        live: Name of the live gain set: original, candidate or accepted; empty while the rig has
            not confirmed it.
        home: Name of the nominal gain set: live between trials.
        why: Why that one.
        gains: The gain sets by name.
        found: Improvement of the candidate in words; empty without a candidate.
        run: The current or last tuning run; empty if there was none.
        trials: Trials finished in that run.
        trials_max: Greatest number of trials in it.
        baseline_cost: Baseline cost of the check trials, if there is one.
        cost: Cost of the last finished trial, if it had one.
        drift: Deviation of the smoothed cost, as a fraction of the limit of the control chart.
        checks: Check trials finished.
        next_check_s: Time until the next check trial, if one is due.
        since: Start of the daemon, ISO 8601 with offset.
        sensitivity: Ms of the live gains with the ends of its 95 % interval, if it is known; null
            for an upper end without bound.
        margins: What is known of the margins, in words; empty before the first record.
        behaviour: Error on a slow triangle (rms), error at its reversals, deviation at rest, in
            the unit of the measurement, of the live gains; if they were measured.
        remedies: What is known of each proven remedy, in words, by its effect.
    """

    rig: str
    instance: str
    mode: str
    sentence: str
    paused: str
    trouble: str
    live: str
    home: str
    why: str
    gains: dict[str, Gains]
    found: str
    run: str
    trials: int
    trials_max: int
    baseline_cost: float | None
    cost: float | None
    drift: float | None
    checks: int
    next_check_s: float | None
    since: str
    sensitivity: tuple[float, float, float | None] | None = None
    margins: str = ""
    behaviour: tuple[float, float, float] | None = None
    remedies: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DaemonEvent(Report):
    """One event.

    Attributes:
        rig: Name of the rig.
        number: Number among the rig's events, from 1; 0 if it could not be stored.
        at: Time of day, ISO 8601 with offset.
        kind: Its kind, one of `estune.daemon.events.EventKind`.
        sentence: Description for the operator.
        facts: Numbers and names that belong to it, as JSON values.
    """

    rig: str
    number: int
    at: str
    kind: str
    sentence: str
    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Events(Report):
    """Past events, oldest first."""

    events: list[DaemonEvent]


@dataclass(frozen=True, slots=True)
class History(Report):
    """Past gain sets, commands and check trials, oldest first each.

    Attributes:
        gains: Gain sets: at, name, P, I, D, setpoint_filter_s, why.
        commands: at, verb, who, done, sentence.
        checks: number, attempt, told_at, outcome, cost, sign, alarm_low, alarm_high.
    """

    gains: list[dict[str, Any]]
    commands: list[dict[str, Any]]
    checks: list[dict[str, Any]]
