"""JSON lines: an object a line, each number in it a channel by its path."""

from pathlib import Path
from typing import Any

import numpy as np

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.readers.mcap import numbers
from estune.support.file_limits import parse_json


def read_json_lines(path: Path) -> RawFile:
    """Reads all objects; texts are channels where they stand at the top, as times and names."""
    rows = list[dict[str, Any]]()
    for place, line in enumerate(path.read_text("utf-8-sig").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = parse_json(line)
        except ValueError as error:
            raise Unusable(f"the line is no JSON ({error}); correct it", row=place) from error
        if not isinstance(row, dict):
            raise Unusable("the line is no JSON object; write one a line", row=place)
        texts = {name: text for name, text in row.items() if isinstance(text, str)}
        rows.append(texts | dict(numbers(row)))
    names = dict.fromkeys(name for row in rows for name in row)
    return RawFile(tuple(_channel(name, [row.get(name) for row in rows]) for name in names), {})


def _channel(name: str, cells: list[Any]) -> Channel:
    plain = [np.nan if cell is None else cell for cell in cells]
    if any(isinstance(cell, str) for cell in plain):
        return Channel(name, np.array(plain, dtype=object))
    return Channel(name, np.array(plain))
