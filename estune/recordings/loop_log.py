"""A log of a control loop as a file gives it: setpoint, measurement and, where logged, effort.

The loop may be any: the units are the file's own. What `read_recording` reads are the columns of
a reel.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import BoolArray, FloatArray
from estune.recordings.channel_search import TIMES, not_found, unused
from estune.recordings.column_map import ColumnTable, Mapped, is_bare, map_column
from estune.recordings.heading import heading
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.long_form import separated
from estune.recordings.loop_channels import loop_channels
from estune.recordings.metadata import Metadata, metadata_beside
from estune.recordings.raw_file import Channel, RawFile, read_raw
from estune.recordings.reports import are_reports, held
from estune.recordings.time_unit import time_doubt
from estune.recordings.timing import Columns, Evened, evened, resampled
from estune.recordings.units import NO_DRUM, UNITS, find_unit

LISTED = 12
"""Channels of a file that a message names at most."""

FEWEST_SAMPLES = 3
"""Fewer rows have no sampling rate."""


DRIFT = 0.02
"""Relative difference of two rates of one controller: a loop that is timed by software runs at
184.0 to 188.4 Hz in logs of a servo, with a jitter of 3 % within each."""

_COMPLETE = 0.5
"""Share of complete rows, below which the columns were logged one by one."""


class LoopLog(NamedTuple):
    """Contents of a file.

    Attributes:
        parts: `time`, `setpoint`, `measurement` and, where it is logged, `effort` of each stretch
            without a gap, shape (samples,) each.
        gains: As the file's metadata states them, or None.
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
        sources: Channels of the columns that are not found by their names.
        sampling_Hz: Rate, where the file has no times.

    Raises:
        Unusable: it cannot be read, or a column is missing; the message is one line.
    """
    raw = separated(read_raw(path))
    metadata = Metadata(raw.metadata or metadata_beside(path))
    rate = sampling_Hz or metadata.number("sampling_Hz", above=0.0)
    channels = loop_channels(raw.channels, sources or {})
    channels, kept = _complete_rows(channels)
    signals = {c: _signal(c, channel) for c, channel in channels.items() if c != "time"}
    values = {c: signal.values for c, signal in signals.items()}
    clocks, doubts = _clocks(raw, channels, signals, kept, rate)
    if min(clock.size for clock in clocks.values()) < FEWEST_SAMPLES and "time" in channels:
        few = min(clock.size for clock in clocks.values())
        raise Unusable(f"the file has {few} rows; {FEWEST_SAMPLES} or more are needed")
    units = {c: _unit(channel) for c, channel in channels.items()}
    _to_one_unit(values, units)
    rows = np.flatnonzero(kept)
    try:
        grid = _on_grid(values, clocks, rate)
    except Unusable as error:
        raise (error if kept.all() else error.among(rows)) from None
    if not kept.all():
        grid = grid._replace(issues=tuple(one.among(rows) for one in grid.issues))
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
    if kept.mean() < _COMPLETE and "time" in channels:  # a row for each change of any
        time_s = _signal("time", channels["time"]).values
        own = {c: one._replace(time_s=time_s) for c, one in channels.items()}
        return own | {"time": channels["time"]}, np.ones(rows, np.bool_)
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


def _doubts(channels: Mapping[str, Channel], time_s: FloatArray) -> Iterator[DataIssue]:
    """A doubt about a time without a unit."""
    time = channels.get("time")
    if time is None or time.time_s is not None or not is_bare(ColumnTable(), time):
        return
    measured = heading(channels["measurement"].name)
    unit = UNITS.get(measured.unit)
    slow = "temp" in measured.key or bool(unit and unit.dimension == "temperature")
    doubt = time_doubt(time.name, time.values, time_s, slow=slow)
    if doubt is not None:
        yield doubt


def _unit(channel: Channel) -> str:
    return find_unit(channel.unit) or heading(channel.name).unit or channel.unit


def _signal(column: str, channel: Channel) -> Mapped:
    """A column's values; of a channel with stamps of its own the rows that have one."""
    import pandas as pd  # noqa: PLC0415  slow to import

    there = ~np.asarray(pd.isna(pd.Series(channel.values)))
    if channel.time_s is not None and not there.all():
        channel = channel._replace(values=channel.values[there], time_s=channel.time_s[there])
    mapped = map_column("time_s" if column == "time" else column, ColumnTable(), channel, NO_DRUM)
    if mapped is None:
        raise Unusable("every cell is empty", column)
    return mapped


def _clocks(
    raw: RawFile,
    channels: Mapping[str, Channel],
    signals: Mapping[str, Mapped],
    kept: BoolArray,
    rate: float | None,
) -> tuple[dict[str, FloatArray], tuple[DataIssue, ...]]:
    """Stamps of each column, the same array where they share a time, and a doubt about it."""
    own = {c: signal.time_s for c, signal in signals.items() if signal.time_s is not None}
    if len(own) == len(signals):
        return own, ()
    if "time" in channels:
        shared = _signal("time", channels["time"]).values
        doubts = () if rate else tuple(_doubts(channels, shared))
    elif rate is not None:
        shared, doubts = np.flatnonzero(kept) / rate, ()
    else:
        asked = not_found("time", unused(raw.channels, channels) or raw.channels, TIMES)
        raise Unusable(f"{asked}; or give --sampling")
    for column, signal in signals.items():
        if column not in own and signal.values.size != shared.size:
            count = f"{signal.values.size} values, the time {shared.size}"
            raise Unusable(f"it has {count}; record both together", column)
    return {c: own.get(c, shared) for c in signals}, doubts


def _on_grid(values: Columns, clocks: Columns, rate: float | None) -> Evened:
    """The columns on an even grid, by what their stamps are: samples, or reports on change."""
    one = clocks["measurement"]
    shared = all(clock is one or np.array_equal(clock, one) for clock in clocks.values())
    if are_reports(values["measurement"], one) and (not shared or _is_ascending(one)):
        return held(values, clocks, rate)
    if shared and rate is not None and one.size > 1:
        own = evened(values, one, None, ("measurement",))
        if abs(own.sampling_Hz / rate - 1.0) <= DRIFT:
            return own._replace(sampling_Hz=rate)
    if shared:
        return evened(values, one, rate, ("measurement",))
    return resampled(values, clocks, rate, ("measurement",))


def _is_ascending(stamps: FloatArray) -> bool:
    return stamps.size > FEWEST_SAMPLES and bool((np.diff(stamps) > 0.0).all())


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
