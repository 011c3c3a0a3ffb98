"""Keys of a rig, and the choice of one rig among those found."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, NamedTuple

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.support.printable import printable

VERSION: Literal[1] = 1

ANY_RIG = "reel/*/*/alive/*"
"""Matches the liveliness tokens of the rigs of every protocol version."""

_CHUNK = re.compile(r"(?!@)[^/*$#?\s](?:[^/*$#?]{0,126}[^/*$#?\s])?")


def check_name(what: str, name: str) -> str:
    """Returns a rig's name or a trial id if it can be part of a key.

    Raises:
        InvalidInput: it cannot.
    """
    if not _CHUNK.fullmatch(name) or printable(name) != name:
        raise InvalidInput(
            f"{what} {name!r} cannot be used on the link: give 1 to 128 characters without "
            "/ * $ # ? or control characters, not beginning with @, not beginning or ending "
            "with a space"
        )
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one rig; `*` for an instance or trial id matches any."""

    rig: str

    def __post_init__(self) -> None:
        check_name("rig name", self.rig)

    @property
    def root(self) -> str:
        """Common prefix."""
        return f"reel/v{VERSION}/{self.rig}"

    def alive(self, instance: str) -> str:
        """Liveliness token of an instance."""
        return f"{self.root}/alive/{instance}"

    def command(self, instance: str, verb: str) -> str:
        """Command to an instance."""
        return f"{self.root}/@cmd/{instance}/{verb}"

    def result(self, trial_id: str) -> str:
        """State or record of a trial."""
        return f"{self.root}/result/{trial_id}"

    def telemetry(self, trial_id: str) -> str:
        """Live samples of the active trial."""
        return f"{self.root}/telemetry/{trial_id}"

    @property
    def status(self) -> str:
        """Current state of the rig."""
        return f"{self.root}/status"

    @property
    def failure(self) -> str:
        """Why the rig's program ends."""
        return f"{self.root}/failure"

    @property
    def describe(self) -> str:
        """Properties of the rig."""
        return f"{self.root}/describe"


class Presence(NamedTuple):
    """A rig that was found, of any protocol version."""

    rig: str
    version: str
    instance: str

    @classmethod
    def parse(cls, key: str) -> "Presence":
        """The rig of a liveliness token's key."""
        _, version, rig, _, instance = printable(key).split("/")
        return cls(rig, version, instance)


def choose(present: Collection[Presence], rig: str | None, endpoint: str) -> Presence:
    """The requested rig among those found.

    Raises:
        ProtocolError: the rig uses another version of the protocol.
        RigError: there is none, not the one requested, more than one, or one name served twice.
    """
    matching = sorted(p for p in present if rig is None or p.rig == rig)
    usable = [p for p in matching if p.version == f"v{VERSION}"]
    names = sorted({p.rig for p in usable})
    if matching and not usable:
        raise ProtocolError(
            f"rig {matching[0].rig!r} at {endpoint} speaks protocol {matching[0].version}, this "
            f"estune v{VERSION}; update the older of the two"
        )
    if not usable and rig is not None and present:
        others = ", ".join(sorted({p.rig for p in present}))
        raise RigError(f"no rig named {rig!r} at {endpoint}; there is: {others}")
    if not usable:
        raise RigError(
            f"no rig answers at {endpoint}, but something there speaks Zenoh: if a rig is served "
            "there, it shows itself only to clients with a right; see --security"
        )
    if len(names) > 1:
        raise RigError(f"{len(names)} rigs at {endpoint}: {', '.join(names)}; name one of them")
    if len(usable) > 1:
        instances = ", ".join(p.instance for p in usable)
        raise RigError(
            f"{len(usable)} processes at {endpoint} serve a rig named {names[0]!r} "
            f"(instances {instances}); stop all but one, or give them different names"
        )
    return usable[0]
