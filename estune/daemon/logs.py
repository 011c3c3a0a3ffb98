"""The daemon's log: JSON lines for machines, plain lines on a terminal."""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

from estune.daemon.events import Event, EventKind

LOGGER = "estune.daemon"

_LEVELS = {
    EventKind.LOST: logging.WARNING,
    EventKind.FAILED: logging.ERROR,
    EventKind.TROUBLE: logging.ERROR,
    EventKind.UNSAFE: logging.ERROR,
    EventKind.DRIFTED: logging.WARNING,
    EventKind.SUSPECT: logging.WARNING,
    EventKind.OUTLIER: logging.WARNING,
}
_log = logging.getLogger(LOGGER)


class JsonLines(logging.Formatter):
    """One JSON object a line: time, level, logger, message; rig, event and facts where known."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        for name in ("rig", "event", "facts"):
            if (value := getattr(record, name, None)) is not None:
                line[name] = value
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class PlainLines(logging.Formatter):
    """Time of day, rig, message."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        at = datetime.fromtimestamp(record.created).astimezone().strftime("%H:%M:%S")
        rig = getattr(record, "rig", None)
        level = "" if record.levelno < logging.WARNING else f"{record.levelname.lower()}: "
        line = f"{at} {f'{rig}: ' if rig else ''}{level}{record.getMessage()}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


def begin_logging(form: Literal["auto", "json", "text"], *, verbose: bool = False) -> None:
    """Sends the log to standard error; in the plain form if that is a terminal, or if told so."""
    handler = logging.StreamHandler(sys.stderr)
    plain = form == "text" or (form == "auto" and sys.stderr.isatty())
    handler.setFormatter(PlainLines() if plain else JsonLines())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    logging.getLogger("estune").setLevel(logging.DEBUG if verbose else logging.INFO)


def log_event(event: Event) -> None:
    """Writes an event into the log."""
    _log.log(
        _LEVELS.get(event.kind, logging.INFO),
        "%s",
        event.sentence,
        extra={"rig": event.rig, "event": event.kind.value, "facts": event.facts or None},
    )
