"""Commands to a rig: their payloads, and the table of all verbs."""

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from estune.core.gains import Gains
from estune.core.setting import stated
from estune.remote.messages.codec import Message
from estune.remote.messages.rights import Right
from estune.trial import Setpoint, TrialRequest
from estune.trial.description import omitted_if


def digest(request: TrialRequest) -> str:
    """Checksum of a request: distinguishes requests of one id, and detects a damaged request.

    BLAKE2b of 16 bytes, in hexadecimal digits, over the run, the number, the attempt, the
    profile's strings (in the order of its fields), and the compensation if there is one, in UTF-8,
    each with a zero byte after it; then
    P, I, D, setpoint_filter_s and the profile's numbers in the order of its fields, each as a
    little-endian float64.
    """
    profile: Any = request.profile
    values = list(stated(profile).values())
    words = [request.run, str(request.number), str(request.attempt)]
    words += [value for value in values if isinstance(value, str)]
    words += [request.compensation] if request.compensation else []
    numbers = [*request.gains.as_tuple(), *(v for v in values if not isinstance(v, str))]
    text = "\0".join([*words, ""]).encode()
    packed = struct.pack(f"<{len(numbers)}d", *numbers)
    return hashlib.blake2b(text + packed, digest_size=16).hexdigest()


@dataclass(frozen=True, slots=True)
class Lease(Message):
    """Requests, renews or returns the right to command the rig.

    Attributes:
        action: What is requested.
        lease: The lease: 16 hexadecimal digits drawn at random by the client, new for each.
        holder: The client, in words for people, at most 128 characters.
    """

    action: Literal["acquire", "renew", "release"]
    lease: str
    holder: str = ""


@dataclass(frozen=True, slots=True)
class Submit(Message):
    """Submits a trial, to be run once.

    Attributes:
        lease: The client's lease.
        request: The trial.
        digest: Checksum of the request (section 4). A rig must compare it with the digest in its
            ledger, and may verify it.
    """

    lease: str
    request: TrialRequest
    digest: str


@dataclass(frozen=True, slots=True)
class Cancel(Message):
    """Stops a trial.

    Attributes:
        lease: The client's lease.
        trial_id: The trial; empty for the active one.
    """

    lease: str
    trial_id: str = ""


@dataclass(frozen=True, slots=True)
class Void(Message):
    """Forbids a trial to run, should its submit still arrive.

    Attributes:
        lease: The client's lease.
        trial_id: The trial.
        digest: Digest of its request.
    """

    lease: str
    trial_id: str
    digest: str


@dataclass(frozen=True, slots=True)
class SetGains(Message):
    """Sets the live gains.

    Attributes:
        lease: The client's lease.
        gains: The gains.
        original: The gains that ran before a sharing daemon set others, kept as long as `gains`
            are live. A rig that cannot keep them refuses the field, and is sent the gains alone.
    """

    lease: str
    gains: Gains
    original: Annotated[Gains | None, omitted_if(None)] = None


@dataclass(frozen=True, slots=True)
class SwitchOff(Message):
    """Switches compensations of the rig off, until its next start. Nothing switches one on.

    Attributes:
        lease: The client's lease.
        tables: Names of the tables of `[compensation]`, at least one.
    """

    lease: str
    tables: Annotated[tuple[str, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True)
class Follow(Message):
    """Sets the setpoint for a short time, between trials. Sent again and again, by a source above.

    Attributes:
        lease: The client's lease.
        sent_s: Time of sending by any clock of the client that runs evenly, s.
        setpoint: The setpoint.
    """

    lease: str
    sent_s: float
    setpoint: Setpoint


@dataclass(frozen=True, slots=True)
class Estop(Message):
    """Brings the rig to its safe state at once. Needs no lease.

    Attributes:
        reason: Reason and sender, in words for people.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Clear(Message):
    """Resets the emergency stop, after the operator has removed its cause. Needs no lease."""


@dataclass(frozen=True, slots=True)
class Inquire(Message):
    """Queries the state of a trial.

    Attributes:
        digest: Digest of its request.
        offset: First byte of the record's frame to return.
        length: Largest number of bytes to return; 0 leaves it to the rig.
    """

    digest: str
    offset: int = 0
    length: int = 0


class Verb(NamedTuple):
    """One command of the protocol, sent to `@cmd/<instance>/<verb>`.

    The server executes it in the method of `RequestHandler` that bears the verb's name.

    Attributes:
        reply: The reply, in words of the protocol page.
        threads: Number of threads that serve it alone; 0 for one that it shares.
        right: Least right of its sender.
        optional: Whether a rig may lack it: it was added after the first version.
    """

    message: type[Message]
    reply: str = "[Answer](#answer)"
    threads: int = 0
    right: Right = Right.COMMAND
    optional: bool = False


VERBS: Mapping[str, Verb] = MappingProxyType(
    {
        "lease": Verb(Lease, threads=1),
        "submit": Verb(
            Submit,
            "[Answer](#answer), or the record's frame (section 5) if it is at hand",
            threads=2,  # one of them may be running a trial
        ),
        "cancel": Verb(
            Cancel,
            "[Answer](#answer), with the `trial_id` that has not ended yet, empty if none",
        ),
        "void": Verb(Void, "[Answer](#answer): `void`, or the trial's state in the ledger"),
        "gains": Verb(SetGains),
        "switch_off": Verb(SwitchOff, optional=True),
        "follow": Verb(
            Follow,
            "[Following](#following) if it is in force, else [Answer](#answer)",
            threads=1,
            optional=True,
        ),
        "estop": Verb(
            Estop,
            "[Answer](#answer), once the rig is on its way to its safe state",
            threads=1,
            right=Right.STOP,
        ),
        "clear": Verb(Clear),
    }
)
"""All commands, by verb: the table from which server, client, access and pages are made."""

VERB_OF: Mapping[type[Message], str] = MappingProxyType(
    {verb.message: name for name, verb in VERBS.items()}
)
