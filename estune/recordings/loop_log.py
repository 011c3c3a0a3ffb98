"""A log of a control loop as a file gives it: setpoint, measurement and, where logged, effort.

The loop may be any: the units are the file's own. What `read_recording` reads are the columns of
a reel.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import BoolArray
from estune.recordings.column_map import ColumnTable, find_channel, map_column
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.metadata import Metadata, metadata_beside
from estune.recordings.raw_file import Channel, RawFile, read_raw
from estune.recordings.timing import Columns, evened
from estune.recordings.units import NO_DRUM, UNITS, find_unit

NAMES = {
    "time": ("time", "t", "timestamp", "stamp", "seconds"),
    "setpoint": ("setpoint", "sp", "reference", "ref", "target", "desired", "r"),
    "measurement": (
        *("measurement", "measured", "pv", "process value", "process variable", "actual"),
        *("feedback", "tension", "temperature", "speed", "velocity", "position", "angle", "y"),
    ),
    "effort": (
        *("effort", "output", "out", "op", "co", "mv", "control", "control output"),
        *("controller output", "control effort", "manipulated variable", "u"),
        *("duty", "duty cycle", "pwm", "valve"),
    ),
}
"""Names of channels, without unit, by which each column is found; the first that fits."""

_BRACKETED = re.compile(r"\s*[\[(][^\[\]()]*[\])]\s*$")
"""What stands in brackets at the end of a name: its unit, whichever it is."""

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
    channels = {c: ch for c in COLUMNS if (ch := _channel(raw, c, given.get(c)))}
    for column in ("setpoint", "measurement"):
        if column not in channels:
            remedy = f"name it, as in --map {column}=NAME"
            raise Unusable(f"no channel is the {column}; the file has {_listed(raw)}: {remedy}")
    channels, kept = _complete_rows(channels)
    values = {c: _values(c, channel) for c, channel in channels.items()}
    time_s = values.pop("time", None)
    if time_s is None:
        if rate is None:
            raise Unusable(
                f"no channel is the time; the file has {_listed(raw)}: name it, as in "
                "--map time=NAME, or give --sampling"
            )
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
    issues = (*_left_out(kept), *grid.issues, *_without_effort(raw, channels))
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


def _listed(raw: RawFile) -> str:
    return ", ".join(channel.name for channel in raw.channels[:LISTED])


def _channel(raw: RawFile, column: str, source: str | None) -> Channel | None:
    if source:
        found = find_channel(source, raw.channels, column)
        if found is None:
            raise Unusable(f"there is no {source}; the file has {_listed(raw)}", column)
        return found
    bare = {channel.name: _bare(channel.name) for channel in raw.channels}
    for name in NAMES[column]:
        fitting = [channel for channel in raw.channels if bare[channel.name] == name]
        if len(fitting) > 1:
            listed = ", ".join(channel.name for channel in fitting)
            raise Unusable(f"{listed} could each be the {column}; name it", column)
        if fitting:
            return fitting[0]
    return None


def _bare(name: str) -> str:
    """A channel's name without folder and unit, in small letters."""
    without = _BRACKETED.sub("", name)  # before the folder: units have a "/"
    last = without.replace(".", "/").rpartition("/")[2].strip().replace(" ", "_")
    stem, _, unit = last.rpartition("_")
    words = stem if stem and (find_unit(unit) or unit == "degC" or not unit.isalnum()) else last
    return words.replace("_", " ").lower()


def _unit(channel: Channel) -> str:
    stated = channel.unit or channel.name.rpartition("_")[2]
    return find_unit(stated) or channel.unit


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
    values["setpoint"] = values["setpoint"] * (own.factor / wanted.factor)
    units["setpoint"] = units["measurement"]
