"""Tables as text: any separator, decimal point or comma, comments, units in the heading."""

import itertools
import re
import warnings
from pathlib import Path
from typing import NamedTuple

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.units import find_unit

_HEAD_LINES = 200
"""Lines among which the heading must come; what is above it are comments."""
_UNIT = re.compile(r"^(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]$")


class _Layout(NamedTuple):
    """Format of the table: separator, decimal mark and header."""

    names: list[str]
    units: list[str]
    skipped: int
    separator: str
    decimal: str


def read_text(path: Path) -> RawFile:
    """Reads a table with a heading; one without names its columns 1, 2, and so on."""
    import pandas as pd  # noqa: PLC0415  slow to import

    layout = _layout(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                path,
                sep=layout.separator,
                decimal=layout.decimal,
                header=None,
                names=layout.names,
                skiprows=layout.skipped,
                encoding="utf-8-sig",
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
            )
    except pd.errors.ParserWarning as error:
        raise Unusable("rows have more cells than the heading; name every column") from error
    except pd.errors.EmptyDataError:
        return RawFile((), {})
    except pd.errors.ParserError as error:
        line = re.search(r"line (\d+)", str(error))
        raise Unusable(
            "the row has more cells than the heading, or a quote is not closed; correct it",
            row=int(line[1]) - layout.skipped if line else None,
        ) from error
    named = zip(layout.names, layout.units, strict=True)
    return RawFile(tuple(Channel(n, frame[n].to_numpy(), unit) for n, unit in named), {})


def _layout(path: Path) -> _Layout:
    with path.open(encoding="utf-8-sig") as file:
        lines = list(itertools.islice(file, _HEAD_LINES))
    first = next((n for n, line in enumerate(lines) if line.strip() and line[0] not in "#%"), None)
    if first is None:
        raise Unusable("the file is empty; record the trial again or remove it")
    head, second = lines[first], lines[first + 1] if first + 1 < len(lines) else ""
    separator = max(",;\t|", key=head.count)
    if separator not in head:
        separator = r"\s+" if len(head.split()) == len(second.split()) > 1 else ","
    names = _cells(head, separator)
    decimal = "," if separator != "," and "," in "".join(lines[first + 1 : first + 3]) else "."
    if all(_is_number(cell, decimal) for cell in names):
        numbered = [str(n + 1) for n in range(len(names))]
        return _Layout(numbered, [""] * len(names), first, separator, decimal)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise Unusable("two columns have this name; rename or remove one", twice)
    found = [_UNIT.match(name) for name in names]
    known = [m["unit"] if m and find_unit(m["unit"]) else "" for m in found]
    bare = [
        m["name"] if m and unit else name
        for m, unit, name in zip(found, known, names, strict=True)
    ]
    below = _cells(second, separator)
    if len(below) == len(names) and any(below) and all(not c or find_unit(c) for c in below):
        return _Layout(bare, below, first + 2, separator, decimal)
    return _Layout(bare, known, first + 1, separator, decimal)


def _cells(line: str, separator: str) -> list[str]:
    cells = line.split() if separator == r"\s+" else line.rstrip("\r\n").split(separator)
    return [cell.strip().strip('"').strip() for cell in cells]


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return True
