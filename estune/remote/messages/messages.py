"""Commands and answers: small JSON objects, checked on arrival.

Unknown fields, missing fields, wrong types, NaN and infinities are refused.
"""

import hashlib
import struct
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from estune import errors
from estune.core.gains import Gains
from estune.errors import EstuneError, ProtocolError, RigError
from estune.remote.messages.keys import VERSION
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import RigDescription, TrialRequest, record_frame

if TYPE_CHECKING:
    from pydantic import TypeAdapter

COMMAND_MAX_BYTES = 2 * 2**10
"""What a microcontroller takes in one piece."""
ANSWER_MAX_BYTES = 64 * 2**10
HOLDER_MAX = 128
"""Characters in which the holder of a lease is told of."""

_STRICT = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
_Message = TypeVar("_Message")


def digest(request: TrialRequest) -> str:
    """Tells two requests apart that claim the same trial id, and a request from a damaged one.

    BLAKE2b of 16 bytes, in hexadecimal digits, over the run, the number, the attempt, and the
    profile's words (its fields that are strings, in their order), in UTF-8, each with a zero byte
    after it; then P, I, D, setpoint_filter_s and the profile's numbers in their order, each as a
    little-endian float64.
    """
    gains, profile = request.gains, request.profile
    words, numbers = [request.run, str(request.number), str(request.attempt)], [*gains.as_tuple()]
    kind: Any = type(profile)  # hashable, though its instances are not to mypy
    for name in _names(kind):
        value = getattr(profile, name)
        if isinstance(value, str):
            words.append(value)
        else:
            numbers.append(value)
    text = "\0".join([*words, ""]).encode()
    packed = struct.pack(f"<{len(numbers)}d", *numbers)
    return hashlib.blake2b(text + packed, digest_size=16).hexdigest()


@cache
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


@dataclass(frozen=True, slots=True)
class Lease:
    """Asks for the right to command the rig, keeps it, or gives it back.

    Attributes:
        action: What is wanted.
        lease: The lease: 16 hexadecimal digits drawn at random by the client, new for each.
        holder: Who asks, in words for people, at most 128 characters.
    """

    __pydantic_config__: ClassVar = _STRICT
    action: Literal["acquire", "renew", "release"]
    lease: str
    holder: str = ""


@dataclass(frozen=True, slots=True)
class Submit:
    """Asks for a trial to be run, once.

    Attributes:
        lease: The lease of who asks.
        request: The trial.
        digest: What tells the request from another under the same id. A rig compares it with
            that in its ledger; it need not know how it is made, but can refuse a request that was
            damaged on the way if it does.
    """

    __pydantic_config__: ClassVar = _STRICT
    lease: str
    request: TrialRequest
    digest: str


@dataclass(frozen=True, slots=True)
class Inquire:
    """Asks for the state of a trial.

    Attributes:
        digest: That of its request.
        offset: From which byte of its record's frame on.
        length: How many bytes at most; 0 leaves it to the rig.
    """

    __pydantic_config__: ClassVar = _STRICT
    digest: str
    offset: int = 0
    length: int = 0


@dataclass(frozen=True, slots=True)
class Cancel:
    """Asks for a trial to be stopped.

    Attributes:
        lease: The lease of who asks.
        trial_id: Which; empty for whichever is under way.
    """

    __pydantic_config__: ClassVar = _STRICT
    lease: str
    trial_id: str = ""


@dataclass(frozen=True, slots=True)
class Void:
    """Asks that a trial never run, should its submit still arrive.

    Attributes:
        lease: The lease of who asks.
        trial_id: Which.
        digest: That of its request.
    """

    __pydantic_config__: ClassVar = _STRICT
    lease: str
    trial_id: str
    digest: str


@dataclass(frozen=True, slots=True)
class SetGains:
    """Asks for gains to be made the live ones.

    Attributes:
        lease: The lease of who asks.
        gains: The gains.
    """

    __pydantic_config__: ClassVar = _STRICT
    lease: str
    gains: Gains


@dataclass(frozen=True, slots=True)
class Estop:
    """Asks for the safe state, at once. Needs no lease.

    Attributes:
        reason: Why, and who asks, in words for people.
    """

    __pydantic_config__: ClassVar = _STRICT
    reason: str


@dataclass(frozen=True, slots=True)
class Clear:
    """Says that whoever asks has seen to the rig: the emergency stop is over. Needs no lease."""

    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Answer:
    """What a rig answers where the answer is not a record.

    Attributes:
        verdict: The answer in one word.
        trial_id: The trial the verdict is about; of `busy` the one under way.
        error: The kind of error, a name of `estune.errors`, where `refused`; else empty.
        sentence: Why not, in words for people; may be empty.
    """

    __pydantic_config__: ClassVar = _STRICT
    verdict: ReplyCode
    trial_id: str = ""
    error: str = ""
    sentence: str = ""

    def check(self) -> None:
        """Raises the error the rig raised, or says no in its words, where the answer is no."""
        if self.verdict is ReplyCode.REFUSED:
            kind = _ERRORS.get(self.error, RigError)
            raise kind(self.sentence)
        if self.verdict in _NOES:
            raise RigError(self.sentence or self.verdict.sentence)


_NOES = (ReplyCode.BUSY, ReplyCode.HELD, ReplyCode.NO_LEASE, ReplyCode.SAFE)


@dataclass(frozen=True, slots=True)
class Status:
    """What a rig does now.

    Attributes:
        instance: The start of the rig that says so.
        mode: What it does.
        trial_id: The trial in hand, or empty.
        ended: How many trials have ended since the rig started.
        holder: Who holds the lease, or empty.
        latched: Why the emergency stop was called; empty if it was not, or was cleared.
    """

    __pydantic_config__: ClassVar = _STRICT
    instance: str
    mode: Mode
    trial_id: str
    ended: int
    holder: str
    latched: str


@dataclass(frozen=True, slots=True)
class Description:
    """What a rig is, and how it is spoken to. A rig without limits has infinite ones.

    Attributes:
        rig: What it says of itself.
        instance: This start of it; part of the keys of its commands.
        ledger: Tells the ledger it keeps from any other; survives a restart if the ledger does.
        protocol: The version it speaks.
    """

    __pydantic_config__: ClassVar = {
        "extra": "forbid",
        "ser_json_inf_nan": "strings",  # JSON has no other way to write an infinity
    }
    rig: RigDescription
    instance: str
    ledger: str
    protocol: Literal[1] = VERSION


_ERRORS: dict[str, type[EstuneError]] = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, EstuneError)
}
COMMANDS = (Lease, Submit, Inquire, Cancel, Void, SetGains, Estop, Clear)
ANSWERS = (Answer, Status, Description)


def refusal(error: EstuneError, trial_id: str = "") -> Answer:
    """The answer that makes the client raise the same error."""
    return Answer(ReplyCode.REFUSED, trial_id, type(error).__name__, str(error))


def encode(message: Any) -> bytes:
    """A command or an answer as JSON.

    Raises:
        ProtocolError: it is too large, or holds what JSON cannot.
    """
    try:
        text = _adapters()[type(message)].dump_json(message, warnings=False)
    except ValueError as error:
        raise ProtocolError(
            f"{type(message).__name__} message: {record_frame.one_line(error)}"
        ) from error
    limit = COMMAND_MAX_BYTES if isinstance(message, COMMANDS) else ANSWER_MAX_BYTES
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
    limit = COMMAND_MAX_BYTES if kind in COMMANDS else ANSWER_MAX_BYTES
    if len(data) > limit:
        raise ProtocolError(f"{kind.__name__} message of {len(data)} bytes; the limit is {limit}")
    try:
        message: _Message = _adapters()[kind].validate_json(data)
    except (ValueError, OverflowError) as error:  # a whole number may have hundreds of digits
        raise ProtocolError(f"{kind.__name__} message: {record_frame.one_line(error)}") from error
    return message


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

    return {kind: TypeAdapter(kind) for kind in (*COMMANDS, *ANSWERS)}
