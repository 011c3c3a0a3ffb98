"""InfluxDB's line protocol: `measurement,tag=x field=1.2,other=3i 1700000000000000000`."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.time_unit import epoch_unit
from estune.recordings.units import UNITS

_LINE = re.compile(
    r"(?P<series>(?:\\.|[^ \\])+) "
    r'(?P<fields>(?:"(?:\\.|[^"\\])*"|\\.|[^ "\\])+)'
    r"(?: (?P<time>-?\d+))?"
)
_FIELD = re.compile(r'((?:\\.|[^,=\\])+)=("(?:\\.|[^"\\])*"|[^,]*)')
_STATES = {"t": 1.0, "true": 1.0, "f": 0.0, "false": 0.0}


def read_line_protocol(path: Path) -> RawFile:
    """Reads each numeric field of each series as a channel with stamps of its own."""
    rows: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
    for place, line in enumerate(path.read_text("utf-8-sig").splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        found = _LINE.fullmatch(line.strip())
        if found is None or found["time"] is None:
            raise Unusable("the line is no line protocol with a time; export it again", row=place)
        for field, text in _FIELD.findall(found["fields"]):
            number = _number(text)
            if number is not None:
                rows[f"{found['series']}.{field}"].append((int(found["time"]), number))
    begin = min((row[0][0] for row in rows.values()), default=0)
    unit = epoch_unit(np.array([begin])) or "ns"
    channels = []
    for name, pairs in rows.items():
        stamps, first = np.unique(np.array([t for t, _ in pairs], np.int64), return_index=True)
        values = np.array([value for _, value in pairs], np.float64)[first]
        channels.append(
            Channel(
                name, values, "", np.asarray((stamps - begin) * UNITS[unit].factor, np.float64)
            )
        )
    return RawFile(tuple(channels), {})


def _number(text: str) -> float | None:
    """A field's value; None of a text."""
    try:
        return _STATES[text.lower()] if text.lower() in _STATES else float(text.rstrip("iu"))
    except ValueError:
        return None
