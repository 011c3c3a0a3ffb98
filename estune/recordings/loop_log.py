"""A log of a control loop as a file gives it: setpoint, measurement and, where logged, effort.

The loop may be any: the units are the file's own. What `read_recording` reads are the columns of
a reel.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import BoolArray
from estune.recordings.channel_search import (
    EFFORTS,
    MEASUREMENTS,
    SETPOINTS,
    TIMES,
    by_usual_name,
    find_channel,
    not_found,
    unused,
)
from estune.recordings.column_map import ColumnTable, is_bare, map_column
from estune.recordings.heading import heading, nearest
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.metadata import Metadata, metadata_beside
from estune.recordings.raw_file import Channel, RawFile, read_raw
from estune.recordings.time_unit import time_doubt
from estune.recordings.timing import Columns, evened
from estune.recordings.units import NO_DRUM, UNITS, find_unit

NAMES = {
    "time": TIMES,
    "setpoint": SETPOINTS,
    "measurement": MEASUREMENTS,
    "effort": EFFORTS,
}
"""Names of channels, without unit, by which each column is found; the first that fits."""

COLUMNS = tuple(NAMES)
"""Columns of a log; effort may be missing, time where the rate is stated."""

LISTED = 12
"""Channels of a file that a message names at most."""

FEWEST_SAMPLES = 3
"""Fewer rows have no sampling rate."""


class LoopLog(NamedTuple):
    """Contents of a file.

    Attributes:
        name: Name of the file.
        sampling_Hz: Rate of the grid.
        parts: `time`, `setpoint`, `measurement` and, where it is logged, `effort` of each stretch
            without a gap, shape (samples,) each.
        gains: As the file's metadata states them, or None.
        sources: Channel of each column.
        units: Unit of each column as the file states it, or empty.
        issues: What was done to the time stamps.
    """

    name: str
    sampling_Hz: float
    parts: tuple[Columns, ...]
    gains: Gains | None
    sources: dict[str, str]
    units: dict[str, str]
    issues: tuple[DataIssue, ...]


def read_loop_log(
    path: Path, sources: Mapping[str, str] | None = None, sampling_Hz: float | None = None
) -> LoopLog:
    """Reads the log of a control loop from a file of a known format.

    Args:
        path: The file.
        sources: Channels of the columns that are not found by their names.
        sampling_Hz: Rate, where the file has no times.

    Raises:
        Unusable: it cannot be read, or a column is missing; the message is one line.
    """
    raw, given = read_raw(path), sources or {}
    metadata = Metadata(raw.metadata or metadata_beside(path))
    rate = sampling_Hz or metadata.number("sampling_Hz", above=0.0)
    channels = _channels(raw, given)
    for column in ("setpoint", "measurement"):
        if column not in channels:
            left = unused(raw.channels, channels) or raw.channels
            raise Unusable(not_found(column, left, NAMES[column]))
    channels, kept = _complete_rows(channels)
    values = {c: _values(c, channel) for c, channel in channels.items()}
    doubts = () if rate else tuple(_doubts(channels, values))
    time_s = values.pop("time", None)
    if time_s is None:
        if rate is None:
            asked = not_found(
                "time", unused(raw.channels, channels) or raw.channels, NAMES["time"]
            )
            raise Unusable(f"{asked}; or give --sampling")
        time_s = np.flatnonzero(kept) / rate
    if time_s.size < FEWEST_SAMPLES:
        raise Unusable(f"the file has {time_s.size} rows; {FEWEST_SAMPLES} or more are needed")
    units = {c: _unit(channel) for c, channel in channels.items()}
    _to_one_unit(values, units)
    grid = evened(values, time_s, rate, ("measurement",))
    parts = tuple(
        {"time" if n == "time_s" else n: v for n, v in part.items()}
        for part in grid.parts
        if part["time_s"].size >= FEWEST_SAMPLES
    )
    if not parts:
        raise Unusable(f"no {FEWEST_SAMPLES} rows in a row are without a gap")
    named = {c: channel.name for c, channel in channels.items()}
    issues = (*doubts, *_left_out(kept), *grid.issues, *_without_effort(raw, channels))
    return LoopLog(path.name, grid.sampling_Hz, parts, metadata.gains(), named, units, issues)


def _complete_rows(channels: dict[str, Channel]) -> tuple[dict[str, Channel], BoolArray]:
    """The channels without the rows that lack a value, and which rows of the file are kept.

    A row is no sample where its setpoint, measurement or effort is missing: a gap like any other.
    """
    import pandas as pd  # noqa: PLC0415  slow to import

    rows = channels["measurement"].values.size
    kept: BoolArray = np.ones(rows, np.bool_)
    signals = [channel for column, channel in channels.items() if column != "time"]
    if any(one.time_s is not None or one.values.size != rows for one in channels.values()):
        return channels, kept
    for channel in signals:
        kept &= ~np.asarray(pd.isna(pd.Series(channel.values)))
    if kept.all() or not kept.any():
        return channels, np.ones(rows, np.bool_)
    fewer = {c: one._replace(values=one.values[kept]) for c, one in channels.items()}
    return fewer, kept


def _left_out(kept: BoolArray) -> Iterator[DataIssue]:
    missing = np.flatnonzero(~kept)
    if missing.size:
        count = "a row lacks" if missing.size == 1 else f"{missing.size} rows lack"
        yield DataIssue("warning", f"{count} a value: left out", row=int(missing[0]) + 1)


def _without_effort(raw: RawFile, channels: Mapping[str, Channel]) -> Iterator[DataIssue]:
    """A warning where the effort may be among the channels that were not read."""
    read = {one.name for one in channels.values()}
    others = [one.name for one in raw.channels if one.name not in read]
    if others and "effort" not in channels:
        yield DataIssue(
            "warning",
            "no channel is the control effort, so limits are not seen and the stated gains are "
            f"not checked; not read: {', '.join(others[:LISTED])}; if one is the effort, name it, "
            "as in --map effort=NAME",
        )


def _channels(raw: RawFile, sources: Mapping[str, str]) -> dict[str, Channel]:
    """The channel of each column: as the map names it, else by its name among those left."""
    found: dict[str, Channel] = {}
    for column, source in sources.items():
        channel = find_channel(source, raw.channels, column)
        if channel is None:
            close = ", ".join(nearest([source], [c.name for c in raw.channels]))
            raise Unusable(f"there is no {source}; the nearest in the file are {close}", column)
        found[column] = channel
    for column in COLUMNS:
        if column not in found:
            channel = by_usual_name(unused(raw.channels, found), column, NAMES[column])
            if channel is not None:
                found[column] = channel
    return found


def _doubts(channels: Mapping[str, Channel], values: Columns) -> Iterator[DataIssue]:
    """A doubt about a time without a unit."""
    time = channels.get("time")
    if time is None or time.time_s is not None or not is_bare(ColumnTable(), time):
        return
    measured = heading(channels["measurement"].name)
    unit = UNITS.get(measured.unit)
    slow = "temp" in measured.key or bool(unit and unit.dimension == "temperature")
    doubt = time_doubt(time.name, time.values, values["time"], slow=slow)
    if doubt is not None:
        yield doubt


def _unit(channel: Channel) -> str:
    return find_unit(channel.unit) or heading(channel.name).unit or channel.unit


def _values(column: str, channel: Channel) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    name = "time_s" if column == "time" else column
    mapped = map_column(name, ColumnTable(), channel, NO_DRUM)
    if mapped is None:
        raise Unusable("every cell is empty", column)
    return np.asarray(mapped.values)


def _to_one_unit(values: dict[str, np.ndarray], units: dict[str, str]) -> None:
    """Brings the setpoint to the unit of the measurement."""
    own, wanted = (UNITS.get(units[c]) for c in ("setpoint", "measurement"))
    if own is None or wanted is None or own == wanted:
        return
    if own.dimension != wanted.dimension:
        raise Unusable(
            f"the setpoint is in {units['setpoint']}, the measurement in {units['measurement']}; "
            "map columns of the same quantity",
            "setpoint",
        )
    in_si = values["setpoint"] * own.factor + own.offset
    values["setpoint"] = (in_si - wanted.offset) / wanted.factor
    units["setpoint"] = units["measurement"]
