"""What is said over the link: keys, commands, answers. No transport is in here.

::

    reel/v1/<rig>/alive/<instance>           liveliness; the instance is new at each boot
    reel/v1/<rig>/@cmd/<instance>/submit     a trial request in, the state of that trial out
    reel/v1/<rig>/@cmd/<instance>/cancel     stop the trial under way
    reel/v1/<rig>/@cmd/<instance>/gains      make gains the live ones
    reel/v1/<rig>/result/<trial id>          the state of a trial; its record once it has ended
    reel/v1/<rig>/status                     what the rig does now; also published at each change
    reel/v1/<rig>/describe                   what the rig is

A chunk that begins with `@` is matched by no wildcard: no `reel/**` ever reaches a command. A
command names the instance: none ever reaches a rig restarted meanwhile. Every command may be
repeated until it is answered: a trial is known by its id and the digest of its request, and never
runs twice. An empty reply says nothing; in particular it does not say "did not run".

Commands and answers are small JSON objects, checked on arrival: unknown fields, missing fields,
wrong types, NaN and infinities are refused. A record travels as the frame of `estune.frame`.
"""

import hashlib
import re
import struct
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from estune import errors, frame
from estune.core.gains import Gains
from estune.errors import EstuneError, InvalidInput, ProtocolError, RigError
from estune.trial import RigDescription, TrialRecord, TrialRequest

if TYPE_CHECKING:
    from pydantic import TypeAdapter

VERSION: Literal[1] = 1
COMMAND_MAX_BYTES = 2 * 2**10
"""What a microcontroller takes in one piece."""
ANSWER_MAX_BYTES = 64 * 2**10

ANY_RIG = "reel/*/*/alive/*"
"""Finds the rigs of every protocol version."""

_CHUNK = re.compile(r"(?!@)[^/*$#?\s](?:[^/*$#?\x00-\x1f]{0,126}[^/*$#?\s])?")
_STRICT = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

_NUMBERS = struct.Struct("<8d")
Verb = Literal["submit", "cancel", "gains", "*"]
_Message = TypeVar("_Message")


def check_name(what: str, name: str) -> str:
    """Returns a rig's name or a trial id that can be part of a key.

    Raises:
        InvalidInput: it cannot.
    """
    if not _CHUNK.fullmatch(name):
        raise InvalidInput(
            f"{what} {name!r} cannot be used on the link: give 1 to 128 characters without "
            "/ * $ # ?, not beginning with @, not beginning or ending with a space"
        )
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one rig."""

    rig: str

    def __post_init__(self) -> None:
        check_name("rig name", self.rig)

    def alive(self, instance: str) -> str:
        """Where an instance shows that it lives; `*` for any."""
        return f"reel/v{VERSION}/{self.rig}/alive/{instance}"

    def command(self, instance: str, verb: Verb) -> str:
        """Where an instance takes commands; `*` is the rig's own declaration."""
        return f"reel/v{VERSION}/{self.rig}/@cmd/{instance}/{verb}"

    def result(self, trial_id: str) -> str:
        """Where the state of a trial is asked for."""
        return f"reel/v{VERSION}/{self.rig}/result/{trial_id}"

    @property
    def anything(self) -> str:
        """All but the commands; the rig's own declaration."""
        return f"reel/v{VERSION}/{self.rig}/**"

    @property
    def status(self) -> str:
        """Where the rig says what it does."""
        return f"reel/v{VERSION}/{self.rig}/status"

    @property
    def describe(self) -> str:
        """Where the rig says what it is."""
        return f"reel/v{VERSION}/{self.rig}/describe"


@dataclass(frozen=True, slots=True, order=True)
class Presence:
    """A rig that was found, of whatever protocol version."""

    rig: str
    version: str
    instance: str

    @classmethod
    def parse(cls, key: str) -> "Presence":
        """The presence a liveliness key tells of."""
        _, version, rig, _, instance = key.split("/")
        return cls(rig, version, instance)


def choose(present: Collection[Presence], rig: str | None, endpoint: str) -> Presence:
    """The one rig meant among those found.

    Args:
        present: All that were found, whatever their version.
        rig: The name asked for, or None where the only one is meant.
        endpoint: Where was looked, for the message.

    Raises:
        ProtocolError: the rig speaks another version of the protocol.
        RigError: there is none, not the one asked for, more than one, or one name served twice.
    """
    meant = sorted(p for p in present if rig is None or p.rig == rig)
    spoken = [p for p in meant if p.version == f"v{VERSION}"]
    names = sorted({p.rig for p in spoken})
    if meant and not spoken:
        raise ProtocolError(
            f"rig {meant[0].rig!r} at {endpoint} speaks protocol {meant[0].version}, this estune "
            f"v{VERSION}; update the older of the two"
        )
    if not spoken and rig is not None and present:
        others = ", ".join(sorted({p.rig for p in present}))
        raise RigError(f"no rig named {rig!r} at {endpoint}; there is: {others}")
    if not spoken:
        raise RigError(
            f"no rig answers at {endpoint}; start one there with: estune serve --listen {endpoint}"
        )
    if len(names) > 1:
        raise RigError(
            f"{len(names)} rigs at {endpoint}: {', '.join(names)}; name the one you mean"
        )
    if len(spoken) > 1:
        instances = ", ".join(p.instance for p in spoken)
        raise RigError(
            f"{len(spoken)} processes at {endpoint} serve a rig named {names[0]!r} "
            f"(instances {instances}); stop all but one, or give them different names"
        )
    return spoken[0]


def digest(request: TrialRequest) -> str:
    """Tells two requests apart that claim the same trial id."""
    gains, step = request.gains, request.step
    numbers = _NUMBERS.pack(
        *(gains.P, gains.I, gains.D, gains.setpoint_filter_s),
        *(step.preload_N, step.step_N, step.step_at_s, step.duration_s),
    )
    names = f"{request.run}\0{request.number}\0{request.attempt}\0"
    return hashlib.blake2b(names.encode() + numbers, digest_size=16).hexdigest()


@dataclass(frozen=True, slots=True)
class Submit:
    """Asks for a trial to be run, once.

    Attributes:
        request: The trial.
        digest: What tells the request from another under the same id. The rig compares it and
            need not know how it is made.
    """

    __pydantic_config__: ClassVar = _STRICT
    request: TrialRequest
    digest: str


@dataclass(frozen=True, slots=True)
class Inquire:
    """Asks for the state of a trial."""

    __pydantic_config__: ClassVar = _STRICT
    digest: str


@dataclass(frozen=True, slots=True)
class Cancel:
    """Asks for a trial to be stopped: the one named, or whichever is under way."""

    __pydantic_config__: ClassVar = _STRICT
    trial_id: str = ""


@dataclass(frozen=True, slots=True)
class SetGains:
    """Asks for gains to be made the live ones."""

    __pydantic_config__: ClassVar = _STRICT
    gains: Gains


@dataclass(frozen=True, slots=True)
class Answer:
    """What a rig answers where the answer is not a record.

    Attributes:
        verdict: `accepted`: done, or taken in hand now. `known`: the trial was taken in hand
            before and has not ended. `busy`: another trial is under way. `refused`: see `error`.
            `unknown`: this instance never heard of the trial.
        trial_id: The trial under way, if any.
        error: The kind of error, a name of `estune.errors`, where refused or busy.
        sentence: Its message.
    """

    __pydantic_config__: ClassVar = _STRICT
    verdict: Literal["accepted", "known", "busy", "refused", "unknown"]
    trial_id: str = ""
    error: str = ""
    sentence: str = ""

    def check(self) -> None:
        """Raises the error the rig raised, if it did."""
        if self.verdict in ("refused", "busy"):
            kind = _ERRORS.get(self.error, RigError)
            raise kind(self.sentence)


@dataclass(frozen=True, slots=True)
class Status:
    """What a rig does now.

    Attributes:
        trial_id: The trial under way, or empty.
        ended: How many trials have ended since the rig started.
    """

    __pydantic_config__: ClassVar = _STRICT
    trial_id: str
    ended: int


@dataclass(frozen=True, slots=True)
class Description:
    """What a rig is, and how it is spoken to. A rig without limits has infinite ones."""

    __pydantic_config__: ClassVar = {
        "extra": "forbid",
        "ser_json_inf_nan": "strings",  # JSON has no other way to write an infinity
    }
    rig: RigDescription
    instance: str
    protocol: Literal[1] = VERSION


_ERRORS: dict[str, type[EstuneError]] = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, EstuneError)
}
_COMMANDS = (Submit, Inquire, Cancel, SetGains)


def refusal(error: EstuneError, trial_id: str = "") -> Answer:
    """The answer that makes the client raise the same error."""
    return Answer("refused", trial_id, type(error).__name__, str(error))


def encode(message: Any) -> bytes:
    """A command or an answer as JSON.

    Raises:
        ProtocolError: it is too large, or holds what JSON cannot.
    """
    try:
        text = _adapters()[type(message)].dump_json(message, warnings=False)
    except ValueError as error:
        raise ProtocolError(
            f"{type(message).__name__} message: {frame.one_line(error)}"
        ) from error
    limit = COMMAND_MAX_BYTES if isinstance(message, _COMMANDS) else ANSWER_MAX_BYTES
    if len(text) > limit:
        raise ProtocolError(
            f"a {type(message).__name__} message takes {len(text)} bytes; the limit is {limit}: "
            "use a shorter name"
        )
    return text


def decode(kind: type[_Message], data: bytes) -> _Message:
    """The command or answer of this kind in JSON that has come over the link.

    Raises:
        ProtocolError: it is too large, or not what it should be.
    """
    limit = COMMAND_MAX_BYTES if kind in _COMMANDS else ANSWER_MAX_BYTES
    if len(data) > limit:
        raise ProtocolError(f"{kind.__name__} message of {len(data)} bytes; the limit is {limit}")
    try:
        message: _Message = _adapters()[kind].validate_json(data)
    except ValueError as error:
        raise ProtocolError(f"{kind.__name__} message: {frame.one_line(error)}") from error
    return message


def decode_trial(data: bytes) -> Answer | TrialRecord:
    """What a rig answers to `submit` and `result`: the record, or why there is none.

    Raises:
        ProtocolError: it is neither.
    """
    return decode(Answer, data) if data.startswith(b"{") else frame.decode(data)


def decode_description(data: bytes) -> Description:
    """What a rig answers to `describe`.

    Raises:
        ProtocolError: it is no description.
        EstuneError: what the rig raised instead.
    """
    if data.startswith(b'{"verdict"'):
        decode(Answer, data).check()
    return decode(Description, data)


@cache
def _adapters() -> "dict[type, TypeAdapter[Any]]":
    from pydantic import TypeAdapter  # noqa: PLC0415  slow to import, not needed by every command

    return {kind: TypeAdapter(kind) for kind in (*_COMMANDS, Answer, Status, Description)}
