"""What a daemon tells of: in its log, its history, on the link and to hooks."""

from dataclasses import dataclass
from enum import StrEnum


class EventKind(StrEnum):
    """What has happened."""

    STARTED = "started"
    FOUND = "found"
    LOST = "lost"
    FAILED = "failed"
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
    UNSAFE = "unsafe"
    COMMAND = "command"
    PAUSED = "paused"
    RESUMED = "resumed"
    STOPPING = "stopping"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that has happened.

    Attributes:
        rig: The rig.
        number: Its place among the rig's events, from 1.
        at: When, ISO 8601 with offset.
        kind: What.
        sentence: The same in words.
        facts: Figures and names beside it, as JSON values.
    """

    rig: str
    number: int
    at: str
    kind: EventKind
    sentence: str
    facts: dict[str, object]
