"""Kinds of a daemon's events: in its log and history, on the link, and to hooks."""

from enum import StrEnum


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
