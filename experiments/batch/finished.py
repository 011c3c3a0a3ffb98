"""Rows that are finished, in a file, so that a run that was interrupted goes on."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import estune
import experiments.batch

Row = dict[str, Any]


class Finished:
    """A file of rows, one JSON object a line with its key.

    A row counts only for the code that made it: keys have a digest of the sources.

    Args:
        file: The file, made when the first row is finished.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._known, self._code = file, dict[str, Row](), _digest()
        if file.exists():
            for line in file.read_text("utf-8").splitlines():
                one = json.loads(line)
                self._known[one["key"]] = one["row"]

    def row(self, about: str, measure: Callable[[], Row]) -> Row:
        """The row of what is described, measured unless it is finished."""
        key = hashlib.sha256(f"{self._code} {about}".encode()).hexdigest()
        if key not in self._known:
            self._known[key] = measure()
            self._file.parent.mkdir(parents=True, exist_ok=True)
            with self._file.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "row": self._known[key]}) + "\n")
        return self._known[key]


def _digest() -> str:
    """A digest of the sources of estune and of this experiment."""
    folders = (Path(package.__path__[0]) for package in (estune, experiments.batch))
    files = sorted(file for folder in folders for file in folder.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
