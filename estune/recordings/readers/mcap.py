"""MCAP: messages in JSON, as `estune export --mcap` writes them, and ROS messages.

Each number of a JSON message is a channel, `/topic.field.field[i]`, stamped by its publish time.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.readers.ros import MOST_NUMBERS, read_bag
from estune.support.file_limits import parse_json

MAGIC = b"\x89MCAP0\r\n"
METADATA = "estune"
"""Name of the metadata record in which a record's metadata stand, as JSON under `record`."""


def read_mcap(path: Path) -> RawFile:
    """Reads all JSON channels, or all topics where the file is of ROS."""
    if _profile(path) in ("ros1", "ros2"):
        return read_bag(path)
    from mcap.reader import make_reader  # noqa: PLC0415  an optional dependency

    rows: defaultdict[str, list[dict[str, float]]] = defaultdict(list)
    stamps: defaultdict[str, list[int]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages():
            if channel.message_encoding != "json":
                raise Unusable(
                    f"the messages are encoded as {channel.message_encoding}; record JSON or ROS "
                    "messages, or export CSV",
                    channel.topic,
                )
            rows[channel.topic].append(dict(numbers(parse_json(message.data))))
            stamps[channel.topic].append(message.publish_time)
        about = [m.metadata for m in reader.iter_metadata() if m.name == METADATA]
    begin = min((min(s) for s in stamps.values()), default=0)
    channels = [c for t in rows for c in _channels(t, rows[t], stamps[t], begin)]
    return RawFile(tuple(channels), parse_json(about[0]["record"]) if about else {})


def refuse_compressed(path: Path) -> RawFile:
    """Refuses a bag compressed as a whole."""
    raise Unusable(f"it is compressed as a whole, which nothing opens; run: zstd -d {path.name}")


def _profile(path: Path) -> str:
    """The header's profile: magic, opcode, length of the record, length of the text, the text."""
    with path.open("rb") as file:
        head = file.read(len(MAGIC) + 13)
        if head[: len(MAGIC)] != MAGIC or len(head) < len(MAGIC) + 13:
            raise Unusable("the file is truncated or no MCAP; copy or export it again")
        (length,) = struct.unpack_from("<I", head, len(MAGIC) + 9)
        return file.read(min(length, 256)).decode("utf-8", "replace")


def _channels(
    topic: str, rows: list[dict[str, float]], stamps: list[int], begin_ns: int
) -> Iterator[Channel]:
    if len(rows[0]) > MOST_NUMBERS:
        return
    stamp_ns, order = np.unique(np.array(stamps, np.int64), return_index=True)
    time_s = np.asarray((stamp_ns - begin_ns) * 1e-9, np.float64)
    for name in rows[0]:
        values = np.array([rows[k].get(name, np.nan) for k in order], np.float64)
        yield Channel(f"{topic}.{name}", values, "", time_s)


def numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """The numbers in a JSON value, each with its path."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from numbers(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from numbers(item, f"{name}[{k}]")
    elif isinstance(value, int | float):
        yield name, value
