"""Kinds of a daemon's events: in its log and history, on the link, and to hooks."""

import logging
from enum import StrEnum
from typing import Self


class EventKind(StrEnum):
    """Kind of an event; docs/how-to/daemon.md says when each occurs.

    Attributes:
        level: Level at which it is logged.
    """

    level: int

    def __new__(cls, value: str, level: int = logging.INFO) -> Self:
        """A kind by its value, which alone is stored and sent."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.level = level
        return member

    STARTED = "started"
    FOUND = "found"
    LOST = "lost", logging.WARNING
    FAILED = "failed", logging.ERROR
    DISK = "disk", logging.WARNING
    TROUBLE = "trouble", logging.ERROR
    BACKED_UP = "backed_up"
    GAINS = "gains"
    TUNING = "tuning"
    CONFIRMING = "confirming"
    BETTER = "better"
    KEPT = "kept"
    SUSPECT = "suspect", logging.WARNING
    OUTLIER = "outlier", logging.WARNING
    DRIFTED = "drifted", logging.WARNING
    MARGINS = "margins", logging.WARNING
    PLANT = "plant", logging.WARNING
    DITHER = "dither", logging.WARNING
    REMEDY = "remedy"
    UNSAFE = "unsafe", logging.ERROR
    COMMAND = "command"
    PAUSED = "paused"
    RESUMED = "resumed"
    STOPPING = "stopping"
    STOPPED = "stopped"
