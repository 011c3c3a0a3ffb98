"""Headings of columns: the name and the unit in them.

Units stand in brackets of any kind, or behind a slash, a comma, "in", a blank or an underscore:
`Time [ms]`, `Speed (rpm)`, `U/V`, `Temp, °C`, `OP %`, `speed_rpm`, `timeMs`.
"""

import difflib
import re
import unicodedata
from collections.abc import Iterable
from typing import NamedTuple

from estune.recordings.units import find_unit

_BRACKETED = re.compile(r"^(?P<name>.*?)\s*[\[({<](?P<unit>[^\[\](){}<>]*)[\])}>]\s*$")
_BEHIND = (
    re.compile(r"^(?P<name>[^/].*?)\s*/\s*(?P<unit>[^/]+|[^/]+/[^/]+)$"),
    re.compile(r"^(?P<name>.+?)\s*,\s*(?P<unit>[^,]+)$"),
    re.compile(r"^(?P<name>.+?)\s+in\s+(?P<unit>\S+)$"),
)
_BLANK = re.compile(r"^(?P<name>.+?)\s+(?P<unit>\S{2,}|%)$")  # of one letter is "Channel A"
_JOINED = (
    re.compile(r"^(?P<name>.+)_(?P<unit>[^_]+)$"),
    re.compile(r"^(?P<name>.*[a-z])(?P<unit>Ms|Us|Deg|Rpm|RPM|Rad)$"),
)
_CAMEL = {"Ms": "ms", "Us": "us"}
_WORDS = ("in", "min")
"""Units that are words, too: `force_in` is no length."""
_REPEATED = re.compile(r"#\d+$")

NEAREST = 3
"""Channels that a message proposes."""


class ColumnHeading(NamedTuple):
    """A heading taken apart.

    Attributes:
        unit: Name in `units.UNITS`; empty where there is none that is known.
        said: Whether the unit stands apart from the name, and not as a part of it: `angle_deg` may
            be a name.
    """

    name: str
    unit: str = ""
    said: bool = False

    @property
    def key(self) -> str:
        """The name without folder, capitals, blanks and underscores."""
        last = re.split(r"[./:]", self.name)[-1] or self.name
        return re.sub(r"[\s_\-]+", "", last).lower()

    @property
    def words(self) -> frozenset[str]:
        """The words of the name, in small letters."""
        parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", self.name)
        return frozenset(word.lower() for word in re.findall(r"[^\W\d_]+", parted))


def heading(text: str) -> ColumnHeading:
    """The name and the unit of a heading."""
    whole = unicodedata.normalize("NFKC", _REPEATED.sub("", text)).strip().strip('"').strip()
    bracketed = _BRACKETED.match(whole)
    if bracketed and bracketed["name"] and not bracketed["unit"].isdecimal():  # an index
        unit = find_unit(bracketed["unit"]) or ""
        return ColumnHeading(bracketed["name"].rstrip(" /"), unit, said=bool(unit))
    for form in (*_BEHIND, _BLANK):
        found = form.match(whole)
        apart = find_unit(found["unit"]) if found else None
        if found and apart:
            return ColumnHeading(found["name"], apart, said=True)
    for form in _JOINED:
        found = form.match(whole)
        written = found["unit"] if found else ""
        joined = find_unit(_CAMEL.get(written, written))
        if found and joined and written not in _WORDS:
            return ColumnHeading(found["name"], joined)
    alone = find_unit(whole)  # a column "ms" or "rpm"
    return ColumnHeading(whole, alone or "", said=False)


def nearest(wanted: Iterable[str], names: Iterable[str]) -> list[str]:
    """The names that resemble the wanted ones most, the most similar first."""
    keys = [heading(name).key for name in wanted]

    def likeness(name: str) -> float:
        own = heading(name).key
        return max((difflib.SequenceMatcher(None, key, own).ratio() for key in keys), default=0.0)

    return sorted(names, key=likeness, reverse=True)[:NEAREST]
