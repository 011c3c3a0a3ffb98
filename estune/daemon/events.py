"""Events of a daemon: in its log and history, on the link, and to hooks."""

from dataclasses import dataclass
from enum import StrEnum

from estune.remote.messages.daemon import EventMessage


class EventKind(StrEnum):
    """Kind of an event; docs/how-to/daemon.md says when each occurs."""

    STARTED = "started"
    FOUND = "found"
    LOST = "lost"
    FAILED = "failed"
    DISK = "disk"
    TROUBLE = "trouble"
    BACKED_UP = "backed_up"
    GAINS = "gains"
    TUNING = "tuning"
    CONFIRMING = "confirming"
    BETTER = "better"
    KEPT = "kept"
    SUSPECT = "suspect"
    OUTLIER = "outlier"
    DRIFTED = "drifted"
    MARGINS = "margins"
    PLANT = "plant"
    DITHER = "dither"
    REMEDY = "remedy"
    UNSAFE = "unsafe"
    COMMAND = "command"
    PAUSED = "paused"
    RESUMED = "resumed"
    STOPPING = "stopping"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class Event:
    """One event.

    Attributes:
        rig: Name of the rig.
        number: Number among the rig's events, from 1; 0 if it could not be stored.
        at: Time of day, ISO 8601 with offset.
        kind: Its kind.
        sentence: Description for the operator.
        facts: Numbers and names that belong to it, as JSON values.
    """

    rig: str
    number: int
    at: str
    kind: EventKind
    sentence: str
    facts: dict[str, object]

    def as_message(self) -> EventMessage:
        """The event as it is sent over the link."""
        kind = self.kind.value
        return EventMessage(self.rig, self.number, self.at, kind, self.sentence, self.facts)
