"""What is said to a daemon and by it: keys, commands, answers. No transport is in here.

::

    reel/v1/<rig>/daemon/alive/<instance>        liveliness; the instance is new at each start
    reel/v1/<rig>/daemon/status                  what it does; also published at each change
    reel/v1/<rig>/daemon/history                 gain sets, commands and check trials
    reel/v1/<rig>/daemon/events                  what has happened; each published as it does
    reel/v1/<rig>/daemon/@cmd/<instance>/<verb>  accept, reject, revert, pause, resume, stop

Commands lie under an `@` chunk, which no wildcard matches. A command has an id and may be repeated
until it is answered: it is carried out once.
"""

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, get_args

from estune.core.gains import Gains
from estune.errors import ProtocolError
from estune.remote.messages.keys import Keys
from estune.remote.messages.messages import COMMAND_MAX_BYTES, HOLDER_MAX
from estune.trial import record_frame

if TYPE_CHECKING:
    from pydantic import TypeAdapter

DaemonVerb = Literal["accept", "reject", "revert", "pause", "resume", "stop"]
VERBS: tuple[str, ...] = get_args(DaemonVerb)

ANSWER_MAX_BYTES = 2**20
ROWS_MAX = 1000
"""Rows of events or history in one answer."""

ANY_DAEMON = "reel/v1/*/daemon/alive/*"
"""Finds the daemons of all rigs."""

_STRICT = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
_Message = TypeVar("_Message")


@dataclass(frozen=True, slots=True)
class DaemonKeys:
    """The keys of the daemon of one rig."""

    rig: str

    @property
    def root(self) -> str:
        """What all of them begin with."""
        return f"{Keys(self.rig).root}/daemon"

    def alive(self, instance: str) -> str:
        """Where an instance shows that it lives; `*` for any."""
        return f"{self.root}/alive/{instance}"

    def command(self, instance: str, verb: str) -> str:
        """Where an instance takes commands."""
        return f"{self.root}/@cmd/{instance}/{verb}"

    def about(self, what: Literal["status", "history", "events"]) -> str:
        """Where the daemon is asked."""
        return f"{self.root}/{what}"


@dataclass(frozen=True, slots=True)
class Command:
    """Asks the daemon to do something.

    Attributes:
        command_id: 16 hexadecimal digits drawn at random, new for each command.
        who: Who asks, in words for people.
        why: Why, in words for people; may be empty.
    """

    __pydantic_config__: ClassVar = _STRICT
    command_id: str
    who: str
    why: str = ""

    def __post_init__(self) -> None:
        if len(self.command_id) != 16 or set(self.command_id) - set("0123456789abcdef"):
            raise ValueError(f"command_id {self.command_id!r:.40} is not 16 hexadecimal digits")
        if not 0 < len(self.who) <= HOLDER_MAX or len(self.why) > HOLDER_MAX:
            raise ValueError(f"who and why may have {HOLDER_MAX} characters, and who at least one")


@dataclass(frozen=True, slots=True)
class Request:
    """Asks for rows of history or events.

    Attributes:
        after: Events after that of this number; below zero the youngest.
        limit: How many at most.
    """

    __pydantic_config__: ClassVar = _STRICT
    after: int = -1
    limit: int = 50

    def __post_init__(self) -> None:
        if not 1 <= self.limit <= ROWS_MAX:
            raise ValueError(f"limit is {self.limit}; it must be from 1 to {ROWS_MAX}")


@dataclass(frozen=True, slots=True)
class CommandAnswer:
    """What became of a command, or why a question was refused.

    Attributes:
        done: Whether it is being carried out.
        sentence: What is being done, or why not.
    """

    __pydantic_config__: ClassVar = _STRICT
    done: bool
    sentence: str


@dataclass(frozen=True, slots=True)
class DaemonStatus:
    """What a daemon does with one rig, and which gains are live.

    Attributes:
        rig: The rig.
        instance: The start of the daemon that says so.
        mode: What is done now.
        sentence: The same in words.
        paused: Why nothing is done; empty if it is not paused.
        trouble: What has last failed; empty once it is over.
        live: Which gain set is live: original, candidate or accepted; empty while that is not
            known, as the rig has not confirmed it.
        home: Which gain set is meant to be live between trials.
        why: Why that one.
        gains: The gain sets that there are, by name.
        found: Why the candidate is better; empty where there is none.
        run: The tuning run under way, or the last one; empty if there was none.
        trials: Trials told in that run.
        trials_max: Greatest number of trials in it.
        baseline_cost: Mean cost that check trials are held to, if they are.
        cost: Cost of the last trial told, if it had one.
        drift: How far the smoothed cost is off, as a share of the limit of the chart.
        checks: Check trials told.
        next_check_s: Time until the next check trial, if one is due.
        since: Since when the daemon runs, ISO 8601 with offset.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}
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


@dataclass(frozen=True, slots=True)
class EventMessage:
    """One thing that has happened; see `estune.daemon.events`."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}
    rig: str
    number: int
    at: str
    kind: str
    sentence: str
    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Events:
    """Things that have happened, oldest first."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}
    events: list[EventMessage]


@dataclass(frozen=True, slots=True)
class History:
    """What was done, oldest first each.

    Attributes:
        gains: Gain sets as they were found or accepted: at, name, P, I, D, setpoint_filter_s, why.
        commands: at, verb, who, done, sentence.
        checks: number, attempt, told_at, outcome, cost, sign.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}
    gains: list[dict[str, Any]]
    commands: list[dict[str, Any]]
    checks: list[dict[str, Any]]


_ASKED = (Command, Request)
_ANSWERED = (CommandAnswer, DaemonStatus, EventMessage, Events, History)


def encode_daemon(message: Any) -> bytes:
    """A message as JSON.

    Raises:
        ProtocolError: it holds what JSON cannot, or is too large.
    """
    try:
        text = _adapters()[type(message)].dump_json(message)
    except ValueError as error:
        raise ProtocolError(f"{type(message).__name__}: {record_frame.one_line(error)}") from error
    _check_size(type(message), text)
    return text


def decode_daemon(kind: type[_Message], data: bytes) -> _Message:
    """The message of this kind in JSON that has come over the link.

    Raises:
        ProtocolError: it is too large, or not what it should be.
    """
    _check_size(kind, data)
    try:
        message: _Message = _adapters()[kind].validate_json(data)
    except ValueError as error:
        raise ProtocolError(f"{kind.__name__}: {record_frame.one_line(error)}") from error
    return message


def _check_size(kind: type, data: bytes) -> None:
    limit = COMMAND_MAX_BYTES if kind in _ASKED else ANSWER_MAX_BYTES
    if len(data) > limit:
        raise ProtocolError(f"{kind.__name__} of {len(data)} bytes; the limit is {limit}")


@cache
def _adapters() -> "dict[type, TypeAdapter[Any]]":
    from pydantic import TypeAdapter  # noqa: PLC0415  slow to import, not needed by every command

    return {kind: TypeAdapter(kind) for kind in (*_ASKED, *_ANSWERED)}
