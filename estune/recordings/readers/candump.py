"""Logs of `candump -l` or `-ta`, decoded by a DBC file beside them."""

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile

_FRAME = re.compile(r"^\s*\((?P<time>\d+\.\d+)\)\s+\S+\s+(?P<id>[0-9A-Fa-f]+)(?P<rest>[#\s].*)$")
_DATA = re.compile(
    r"#(?P<joined>[0-9A-Fa-f]*)\s*\w?$|\[\d+\]\s+(?P<parted>(?:[0-9A-Fa-f]{2}\s*)*)"
)


def is_candump(lines: Iterable[str]) -> bool:
    """Whether a line is a frame."""
    return any(_FRAME.match(line) for line in lines)


def read_candump(path: Path, lines: Iterable[str]) -> RawFile:
    """Reads each signal as a channel, `Message.Signal`, with its unit."""
    from cantools import database  # noqa: PLC0415  an optional dependency

    named = path.with_suffix(".dbc")
    found = [named] if named.is_file() else sorted(path.parent.glob("*.dbc"))
    if len(found) != 1:
        have = f"there are {len(found)}" if found else "there is none"
        raise Unusable(
            f"frames are decoded by a DBC file, and {have}; put it beside, as {named.name}"
        )
    known: Any = database.load_file(found[0])  # a diagnostics database has no messages
    messages = {message.frame_id: message for message in known.messages}
    rows: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for line in lines:
        frame = _FRAME.match(line)
        data = frame and _DATA.search(frame["rest"])
        message = frame and messages.get(int(frame["id"], 16))
        if not (frame and data and message):
            continue
        payload = bytes.fromhex(data["joined"] or data["parted"] or "")
        if len(payload) < message.length:
            continue  # a remote or a shortened frame
        for name, value in message.decode(payload, decode_choices=False).items():
            rows[f"{message.name}.{name}"].append((float(frame["time"]), float(value)))
    units = {f"{m.name}.{s.name}": s.unit or "" for m in known.messages for s in m.signals}
    begin = min((pairs[0][0] for pairs in rows.values()), default=0.0)
    channels = []
    for name, pairs in rows.items():
        stamps, first = np.unique(np.array([t for t, _ in pairs]), return_index=True)
        values = np.array([v for _, v in pairs])[first]
        channels.append(Channel(name, values, units.get(name, ""), stamps - begin))
    return RawFile(tuple(channels), {})
