"""ROS 1 and ROS 2 bags and MCAP files of ROS messages, without ROS, by rosbags.

Each number of a message is a channel, `/topic.field.field[i]`. A message's time is its header's
stamp, or else when it was logged.
"""

import dataclasses
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import BAG, Channel, RawFile

MOST_NUMBERS = 64
"""Topics with more numbers in a message are pictures, clouds or maps, and are left out."""


class Field(NamedTuple):
    """A number in a message: attribute path, index in a sequence, and whether it is a sequence."""

    path: str
    place: int | None

    def __str__(self) -> str:
        """As part of a channel's name."""
        return self.path if self.place is None else f"{self.path}[{self.place}]"

    def value(self, message: Any) -> Any:
        """The number in a message."""
        found = attrgetter(self.path)(message)
        return found if self.place is None else found[self.place]


def read_bag(path: Path) -> RawFile:
    """Reads all topics with numbers. A ROS 2 bag is given by its folder or its metadata.yaml."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415  an optional dependency
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    place = path.parent if path.name == BAG else path
    with AnyReader([place], default_typestore=get_typestore(Stores.LATEST)) as reader:
        topics = dict.fromkeys(connection.topic for connection in reader.connections)
        read = {topic: _Topic.read(reader, topic) for topic in topics}
    begin = min((int(t.stamp_ns.min()) for t in read.values() if t.stamp_ns.size), default=0)
    return RawFile(tuple(c for name, t in read.items() for c in t.channels(name, begin)), {})


class _Topic(NamedTuple):
    """Numbers of a topic: fields, stamps, shape (messages,), values, shape (messages, fields)."""

    fields: list[Field]
    stamp_ns: NDArray[np.int64]
    values: NDArray[np.float64]

    @classmethod
    def read(cls, reader: Any, topic: str) -> "_Topic":
        fields: list[Field] | None = None
        stamps, rows = [], []
        chosen = [c for c in reader.connections if c.topic == topic]
        for connection, logged_ns, data in reader.messages(connections=chosen):
            message = reader.deserialize(data, connection.msgtype)
            if fields is None:
                fields = list(_fields(message))
                if len(fields) > MOST_NUMBERS:
                    fields = []
            if not fields:
                break
            try:
                rows.append([field.value(message) for field in fields])
            except IndexError as error:
                raise Unusable(
                    "the message has fewer numbers than the first of its topic; record topics "
                    "of one length",
                    *(topic, len(rows) + 1),
                ) from error
            stamps.append(_stamp_ns(message) or logged_ns)
        # Stamps that repeat or come late are sorted, the first of each kept.
        stamp_ns, order = np.unique(np.array(stamps, np.int64), return_index=True)
        values = np.array(rows, np.float64).reshape(len(rows), len(fields or ()))
        return cls(fields or [], stamp_ns, values[order])

    def channels(self, topic: str, begin_ns: int) -> Iterator[Channel]:
        time_s = np.asarray((self.stamp_ns - begin_ns) * 1e-9, np.float64)
        for k, field in enumerate(self.fields):
            yield Channel(f"{topic}.{field}", self.values[:, k], "", time_s)


def _stamp_ns(message: Any) -> int:
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    return 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec


def _fields(message: Any, prefix: str = "") -> Iterator[Field]:
    """The numbers of a message but its header's."""
    for field in dataclasses.fields(message):
        if field.name in ("header", "structure_needs_at_least_one_member"):
            continue
        value, path = getattr(message, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{path}.")
        elif isinstance(value, np.ndarray):
            yield from (Field(path, k) for k in range(min(value.size, MOST_NUMBERS + 1)))
        elif isinstance(value, int | float):
            yield Field(path, None)
