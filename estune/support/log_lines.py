"""The log of a command that runs for long: lines of text or JSON on standard error."""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

LogFormat = Literal["auto", "json", "text"]
"""Form of the lines; `auto` is text on a terminal, else JSON."""


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
    """Time with offset, level, rig, message."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        at = datetime.fromtimestamp(record.created).astimezone().isoformat(" ", "seconds")
        rig = getattr(record, "rig", None)
        line = f"{at} {record.levelname.lower()}: {f'{rig}: ' if rig else ''}{record.getMessage()}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


def begin_logging(form: LogFormat, *, verbose: bool = False) -> None:
    """Sends the log to standard error; `auto` is text on a terminal, else JSON."""
    handler = logging.StreamHandler(sys.stderr)
    plain = form == "text" or (form == "auto" and sys.stderr.isatty())
    handler.setFormatter(PlainLines() if plain else JsonLines())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    logging.getLogger("estune").setLevel(logging.DEBUG if verbose else logging.INFO)
