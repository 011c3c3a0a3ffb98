"""Small files beside a run's journal: tags and a note of people, and numbers for a list of runs.

The journal has one writer, the run; these files can be written while it runs.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from estune.errors import InvalidInput
from estune.run.ending import RunEnding
from estune.support.file_limits import parse_json
from estune.support.whole_file import write_file

LABELS, NUMBERS = "labels.json", "numbers.json"
TAGS_MAX, TAG_LENGTH_MAX, NOTE_LENGTH_MAX = 20, 40, 2000


class Labels(NamedTuple):
    """What people say of a run."""

    tags: tuple[str, ...] = ()
    note: str = ""


class ListedNumbers(NamedTuple):
    """What a list of runs shows of a finished one; None where it is unknown.

    Attributes:
        rise_time_s: Rise time with the gains to use.
        overshoot: Overshoot with them, as a share of the step.
        Ms: Sensitivity that is claimed of them.
        cost: Cost of the tuned gains; None where the initial ones are kept.
    """

    rise_time_s: float | None = None
    overshoot: float | None = None
    Ms: float | None = None
    start_cost: float | None = None
    cost: float | None = None
    ending: RunEnding | None = None


def read_labels(run: Path) -> Labels:
    """Tags and note of a run; none where there are none, or the file is damaged."""
    found = _read(run / LABELS)
    tags = found.get("tags", ())
    shown = tuple(map(str, tags)) if isinstance(tags, list) else ()
    return Labels(shown, str(found.get("note", "")))


def write_labels(run: Path, labels: Labels) -> None:
    """Replaces the tags and the note of a run.

    Raises:
        InvalidInput: there are too many, one is too long, or they cannot be written.
    """
    if len(labels.tags) > TAGS_MAX or any(len(tag) > TAG_LENGTH_MAX for tag in labels.tags):
        raise InvalidInput(f"give at most {TAGS_MAX} tags of at most {TAG_LENGTH_MAX} characters")
    if len(labels.note) > NOTE_LENGTH_MAX:
        raise InvalidInput(f"the note is longer than {NOTE_LENGTH_MAX} characters; shorten it")
    _write(run / LABELS, labels._asdict())


def read_numbers(run: Path) -> ListedNumbers:
    """The numbers of a finished run."""
    found = _read(run / NUMBERS)
    ending = found.pop("ending", None)
    given = {name: found.get(name) for name in ListedNumbers._fields}
    known = {n: x for n, x in given.items() if isinstance(x, int | float) and math.isfinite(x)}
    return ListedNumbers(**known, ending=RunEnding(ending) if ending in list(RunEnding) else None)


def write_numbers(run: Path, numbers: ListedNumbers) -> None:
    """Stores the numbers of a finished run.

    Raises:
        InvalidInput: they cannot be written.
    """
    _write(run / NUMBERS, numbers._asdict())


def _read(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _write(path: Path, values: Mapping[str, Any]) -> None:
    write_file(path, (json.dumps(values) + "\n").encode())
