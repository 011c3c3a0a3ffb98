"""LVM, LabVIEW's text: headers up to `***End_of_Header***`, then a table."""

import re
from pathlib import Path

import numpy as np

from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.readers.text import decoded, table

END = "***End_of_Header***"


def read_lvm(path: Path) -> RawFile:
    """Reads the first segment; without a column of X its times are made from `Delta_X`."""
    text = decoded(path)
    head, _, body = text.rpartition(END)
    first = text.split(END)
    if len(first) > 3:
        head, body = END.join(first[:2]), first[2]
    without_x = re.search(r"^X_Columns[\t,;]No", head, re.MULTILINE) is not None
    lines = body.strip("\r\n\t ,;").splitlines()
    if without_x:  # the column of X is there, and empty
        lines = [re.sub(r"^(X_Value)?[\t,;]", "", line) for line in lines]
    raw = table("\n".join(line.rstrip("\t ,;") for line in lines) + "\n")
    kept = [channel for channel in raw.channels if not _is_empty(channel)]
    units = re.search(r"^Y_Unit_Label[\t,;](.*)$", head, re.MULTILINE)
    labels = [label.strip() for label in re.split(r"[\t,;]", units[1])] if units else []
    step = re.search(r"^Delta_X[\t,;]([\d.,eE+-]+)", head, re.MULTILINE)
    if without_x and step:
        step_s = float(step[1].strip(",;").replace(",", "."))
        clock = Channel("X_Value", np.arange(kept[0].values.size) * step_s, "s")
        kept = [clock, *(c for c in kept if c.name != clock.name)]
    named = [c for c in kept if c.name != "X_Value"]
    own = dict(zip((c.name for c in named), labels, strict=False))
    channels = [c._replace(unit=c.unit or own.get(c.name, "")) for c in kept]
    return RawFile(tuple(channels), {})


def _is_empty(channel: Channel) -> bool:
    values = channel.values
    return channel.name == "Comment" or bool(values.dtype.kind == "f" and np.isnan(values).all())
