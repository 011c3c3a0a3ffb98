"""Layout of a table as text: where its data begin, its separator, decimal mark and headings."""

import io
import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

from estune.recordings.heading import heading
from estune.recordings.issue import Unusable
from estune.recordings.units import find_unit

HEAD_LINES = 400
"""Lines among which the data must begin; oscilloscopes and dSPACE write up to 100 above them."""
BLANKS = r"\s+"
_SEPARATORS = (";", "\t", ",", "|", BLANKS)
_COMMENT = "#%"
_DATE = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}([T ].*)?|\d{1,2}:\d{2}(:\d{2}.*)?")
_NUMBER = re.compile(
    r"(?P<number>[-+]?(?:[\d.,]+(?:[eE][-+]?\d+)?|inf|nan))\s*(?P<unit>[^\d\s.,;]{0,6})",
    re.IGNORECASE,
)
_ENOUGH = 0.5
"""Share of numbers in a line of data: beside them stand states, flags and names."""
_UNIT_LENGTH = 12
"""Letters of a unit at most, by which a row of units is told from a row of names."""


class Layout(NamedTuple):
    """Form of a table: headings, a unit for each or none, lines above the data, marks."""

    names: list[str]
    units: list[str]
    skipped: int
    separator: str
    decimal: str


def layout_of(text: str) -> Layout:
    """The layout of a table.

    Raises:
        Unusable: it is empty.
    """
    lines = list(itertools.islice(io.StringIO(text, newline=None), HEAD_LINES))
    if not any(line.strip() for line in lines):
        raise Unusable("the file is empty; record the trial again or remove it")
    begun = _first_data(lines)
    if begun is None:
        return _without_data(lines)
    first, separator, decimal = begun
    count = len(cells(lines[first], separator))
    above = [n for n in range(first) if lines[n].strip()][::-1]
    fitting = [n for n in above[:2] if _fits(lines[n], separator, count)]
    names, units = [str(n + 1) for n in range(count)], [""] * count
    if fitting and fitting[0] == above[0]:
        names = cells(lines[fitting[0]].lstrip(_COMMENT), separator)
        if len(fitting) > 1 and _are_units(names):
            names, units = cells(lines[fitting[1]].lstrip(_COMMENT), separator), names
    elif above and not lines[above[0]].startswith(tuple(_COMMENT)):
        listed = cells(lines[above[0]], separator)
        if len(listed) > 1 and separator != BLANKS:
            names = listed  # too few: the reading of the rows says so
    units += [""] * (len(names) - len(units))
    return Layout(_numbered(names), units[: len(names)], first, separator, decimal)


def cells(line: str, separator: str) -> list[str]:
    """The cells of a line; a separator within quotes is none."""
    if separator == BLANKS:
        parts = line.split()
    elif '"' in line:
        parts = re.split(
            rf'{re.escape(separator)}(?=(?:[^"]*"[^"]*")*[^"]*$)', line.rstrip("\r\n")
        )
    else:
        parts = line.rstrip("\r\n").split(separator)
    return [part.strip().strip('"').strip() for part in parts]


def _first_data(lines: Sequence[str]) -> tuple[int, str, str] | None:
    """The begin of the longest run of lines of numbers, with its separator and decimal mark.

    Instruments write pairs of name and number above their data, which are a shorter run.
    """
    full = [n for n, line in enumerate(lines) if line.strip() and line[0] not in _COMMENT]
    best, found = 0.0, None
    for separator, decimal in itertools.product(_SEPARATORS, ".,"):
        if separator == decimal:
            continue
        begin, count, score = 0, 0, 0.0
        for n in full:
            own = cells(lines[n], separator)
            share = _share_of_numbers(own, decimal)
            within = len(own) == count and share > 0.0  # where a sensor is "unavailable"
            if len(own) < 2 or (share < _ENOUGH and not within):
                count = 0
                continue
            if len(own) != count:
                begin, count, score = n, len(own), 0.0
            score += share
            if score > best:
                best, found = score, (begin, separator, decimal)
    return found


def _without_data(lines: Sequence[str]) -> Layout:
    """The layout of a table without rows, or with rows of texts alone."""
    first = next((n for n, x in enumerate(lines) if x.strip() and x[0] not in _COMMENT), None)
    if first is None:
        raise Unusable("the file is empty; record the trial again or remove it")
    separator = max(",;\t|", key=lines[first].count)
    names = _numbered(cells(lines[first], separator))
    return Layout(names, [""] * len(names), first + 1, separator, ".")


def _share_of_numbers(found: Sequence[str], decimal: str) -> float:
    full = [cell for cell in found if cell]
    numbers = [cell for cell in full if _is_value(cell, decimal)]
    return len(numbers) / len(found) if full else 0.0


def _is_value(cell: str, decimal: str) -> bool:
    return number_with_unit(cell, decimal) is not None or bool(_DATE.fullmatch(cell))


def number_with_unit(cell: str, decimal: str) -> tuple[float, str] | None:
    """A cell as a number and what stands behind it; None where it is no number."""
    found = _NUMBER.fullmatch(cell)
    if found is None or (decimal == "," and "." in found["number"]):
        return None
    try:
        return float(found["number"].replace(decimal, ".")), found["unit"]
    except ValueError:
        return None


def _fits(line: str, separator: str, count: int) -> bool:
    return len(cells(line.lstrip(_COMMENT), separator)) == count


def _are_units(found: Sequence[str]) -> bool:
    """Whether a row is one of units: short, and one of them known at least."""
    full = [cell for cell in found if cell.strip("()[]- ")]
    known = [cell for cell in full if find_unit(cell)]
    short = all(len(cell) <= _UNIT_LENGTH and not heading(cell).said for cell in full)
    return bool(known) and short and 2 * len(known) >= len(full)


def _numbered(names: list[str]) -> list[str]:
    """The names, those that come again with a number behind."""
    seen: dict[str, int] = {}
    unique = []
    for place, name in enumerate(names):
        own = name or f"column {place + 1}"
        seen[own] = seen.get(own, 0) + 1
        unique.append(own if seen[own] == 1 else f"{own}#{seen[own]}")
    return unique
