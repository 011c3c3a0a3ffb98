"""Replies of a rig that are not a record."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from estune import errors
from estune.core.gains import Gains
from estune.errors import EstuneError, RigError
from estune.remote.messages.codec import ANSWER_MAX_BYTES, Message, decode
from estune.remote.messages.keys import VERSION
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import Feedback, RigDescription
from estune.trial.description import omitted_if

_ERRORS: dict[str, type[EstuneError]] = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, EstuneError)
}
_REFUSALS = (ReplyCode.BUSY, ReplyCode.HELD, ReplyCode.NO_LEASE, ReplyCode.SAFE)


@dataclass(frozen=True, slots=True)
class Answer(Message):
    """Reply of a rig where the reply is not a record.

    Attributes:
        verdict: Reply code.
        trial_id: The trial the reply code refers to; of `busy` the active one.
        error: Kind of error, a name of `estune.errors`, where `refused`; else empty.
        sentence: Reason of a refusal, in words for people; may be empty.
    """

    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES
    verdict: ReplyCode
    trial_id: str = ""
    error: str = ""
    sentence: str = ""

    def check(self) -> None:
        """Raises the rig's error, or an error with its sentence, where the reply is a refusal."""
        if self.verdict is ReplyCode.REFUSED:
            kind = _ERRORS.get(self.error, RigError)
            raise kind(self.sentence)
        if self.verdict in _REFUSALS:
            raise RigError(self.sentence or self.verdict.sentence)


@dataclass(frozen=True, slots=True)
class Status(Message):
    """Current state of a rig.

    Attributes:
        instance: Instance of the rig that replies.
        mode: Its mode.
        trial_id: The active trial, or empty.
        ended: Number of trials ended since the rig started.
        holder: Holder of the lease, or empty.
        latched: Reason of the emergency stop; empty if there was none, or it was cleared.
        last: The youngest trial of the ledger; absent unless the query asked for it.
    """

    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES
    instance: str
    mode: Mode
    trial_id: str
    ended: int
    holder: str
    latched: str
    last: Annotated[str, omitted_if("")] = ""


LAST = b"last"
"""Payload of a query of the status that asks for the youngest trial, too."""


@dataclass(frozen=True, slots=True)
class Failure(Message):
    """Last message of a rig whose program cannot go on. Published before it ends.

    Attributes:
        reason: Why, in words for people.
    """

    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES
    reason: str


@dataclass(frozen=True, slots=True)
class Following(Message):
    """Reply to a setpoint that is in force.

    Attributes:
        sent_s: Time of sending of the setpoint, as in its message.
        feedback: State of the reel.
    """

    sent_s: float
    feedback: Feedback


@dataclass(frozen=True, slots=True)
class Description(Message):
    """Properties of a rig, and how to address it. A rig without limits has infinite ones.

    Attributes:
        rig: Properties of the rig.
        instance: This start of it; part of the keys of its commands.
        ledger: Identity of its ledger; survives a restart if the ledger does.
        protocol: Protocol version.
        original: The `original` of the command that set the live gains; absent without one.
    """

    __pydantic_config__: ClassVar = {
        "extra": "forbid",
        "ser_json_inf_nan": "strings",  # JSON has no other way to write an infinity
    }
    max_bytes: ClassVar[int] = ANSWER_MAX_BYTES
    rig: RigDescription
    instance: str
    ledger: str
    protocol: Literal[1] = VERSION
    original: Annotated[Gains | None, omitted_if(None)] = None


def refusal(error: EstuneError, trial_id: str = "") -> Answer:
    """The reply that makes the client raise this error."""
    return Answer(ReplyCode.REFUSED, trial_id, type(error).__name__, str(error))


def decode_following(data: bytes) -> Following:
    """Reply of a rig to a setpoint.

    Raises:
        ProtocolError: it is no such reply.
        EstuneError: the rig refuses the setpoint.
    """
    if data.startswith(b'{"verdict"'):
        decode(Answer, data).check()
    return decode(Following, data)


def decode_description(data: bytes) -> Description:
    """Reply of a rig to `describe`.

    Raises:
        ProtocolError: it is no description.
        EstuneError: the error the rig raised instead.
    """
    if data.startswith(b'{"verdict"'):
        decode(Answer, data).check()
    return decode(Description, data)
