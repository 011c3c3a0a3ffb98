"""Metadata of a record, as other programs may write it."""

import math
from pathlib import Path
from typing import Any, NamedTuple

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.recordings.issue import Unusable
from estune.support.file_limits import parse_json


class Metadata(NamedTuple):
    """Values by name; see `column_names.METADATA`."""

    values: dict[str, Any]

    def number(self, name: str, above: float = -math.inf) -> float | None:
        """A finite number, or None where it is missing or null."""
        value = self.values.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise Unusable(f"{name} is {value!r} in the metadata; give a number")
        if not (math.isfinite(value) and value > above):
            raise Unusable(f"{name} is {value} in the metadata; give a finite number in range")
        return float(value)

    def text(self, name: str) -> str | None:
        """A text, or None where it is missing or null."""
        value = self.values.get(name)
        return None if value is None else str(value)

    def gains(self) -> Gains | None:
        """The controller's gains, or None where they are not known."""
        value = self.values.get("gains")
        if not isinstance(value, dict):
            return None
        try:
            return Gains(*(value[name] for name in ("P", "I", "D", "setpoint_filter_s")))
        except (KeyError, TypeError, InvalidInput):
            return None


def metadata_beside(path: Path) -> dict[str, Any]:
    """The JSON object in the file of the same name with the ending `.json`; empty without one.

    Raises:
        Unusable: it holds something else.
    """
    beside = path.with_name(f"{path.stem}.json")
    if not beside.is_file():
        return {}
    try:
        found = parse_json(beside.read_bytes().decode("utf-8-sig"))
    except ValueError as error:
        raise Unusable(f"{beside.name} is no JSON ({error}); correct it or remove it") from error
    if not isinstance(found, dict):
        raise Unusable(f"{beside.name} holds no JSON object; give the metadata as one")
    return found
