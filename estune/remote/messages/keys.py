"""The keys of a rig, and which of the rigs that were found is meant."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from estune.errors import InvalidInput, ProtocolError, RigError

VERSION: Literal[1] = 1

ANY_RIG = "reel/*/*/alive/*"
"""Finds the rigs of every protocol version."""

Verb = Literal["lease", "submit", "cancel", "void", "gains", "estop", "clear"]

_CHUNK = re.compile(r"(?!@)[^/*$#?\s](?:[^/*$#?\x00-\x1f]{0,126}[^/*$#?\s])?")


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

    @property
    def root(self) -> str:
        """What all of them begin with."""
        return f"reel/v{VERSION}/{self.rig}"

    def alive(self, instance: str) -> str:
        """Where an instance shows that it lives; `*` for any."""
        return f"{self.root}/alive/{instance}"

    def command(self, instance: str, verb: Verb) -> str:
        """Where an instance takes commands."""
        return f"{self.root}/@cmd/{instance}/{verb}"

    def result(self, trial_id: str) -> str:
        """Where the state of a trial is asked for."""
        return f"{self.root}/result/{trial_id}"

    def telemetry(self, trial_id: str) -> str:
        """Where samples of a trial under way are shown; `*` for any."""
        return f"{self.root}/telemetry/{trial_id}"

    @property
    def anything(self) -> str:
        """All but the commands; the rig's own declaration."""
        return f"{self.root}/**"

    @property
    def status(self) -> str:
        """Where the rig says what it does."""
        return f"{self.root}/status"

    @property
    def describe(self) -> str:
        """Where the rig says what it is."""
        return f"{self.root}/describe"


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
