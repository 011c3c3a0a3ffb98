"""Which channels of a file are a control loop: setpoint, measurement, effort and time."""

import re
from collections.abc import Mapping, Sequence

from estune.recordings.channel_search import (
    EFFORTS,
    MEASUREMENTS,
    SETPOINTS,
    TIMES,
    by_usual_name,
    find_channel,
    not_found,
    option,
    unused,
)
from estune.recordings.heading import nearest
from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel

NAMES = {
    "time": TIMES,
    "setpoint": SETPOINTS,
    "measurement": MEASUREMENTS,
    "effort": EFFORTS,
}
"""Names of channels, without unit, by which each column is found; the first that fits."""

COLUMNS = tuple(NAMES)
"""Columns of a log; effort may be missing, time where the rate is stated."""

_FOLDER = re.compile(r"^(?P<folder>.+)[./][^./]+$")


def loop_channels(channels: Sequence[Channel], sources: Mapping[str, str]) -> dict[str, Channel]:
    """The channel of each column: as the map names it, else by its name.

    Of a file with several loops, as of the axes of an aircraft, those beside a mapped one.

    Raises:
        Unusable: setpoint or measurement is not found, or there are several loops.
    """
    found = {column: _mapped(column, source, channels) for column, source in sources.items()}
    beside = _chosen(channels, found)
    for column in COLUMNS:
        if column in found:
            continue
        left = unused(channels, found)
        near = [c for c in left if beside is not None and _folder(c) == beside]
        channel = by_usual_name(near, column, NAMES[column]) if near else None
        if channel is None and (column == "time" or beside is None):
            channel = by_usual_name(left, column, NAMES[column])
        if channel is not None:
            found[column] = channel
    left = unused(channels, found)
    if {"time", "setpoint", "effort"} <= found.keys() and len(left) == 1:
        found.setdefault("measurement", left[0])
    for column in ("setpoint", "measurement"):
        if column not in found:
            raise Unusable(not_found(column, unused(channels, found) or channels, NAMES[column]))
    return found


def _mapped(column: str, source: str, channels: Sequence[Channel]) -> Channel:
    channel = find_channel(source, channels, column)
    if channel is None:
        close = ", ".join(nearest([source], [c.name for c in channels]))
        raise Unusable(f"there is no {source}; the nearest in the file are {close}", column)
    return channel


def _chosen(channels: Sequence[Channel], found: Mapping[str, Channel]) -> str | None:
    """The folder of the loop: that of a mapped channel, or the only one; None without folders."""
    loops = _loops(channels)
    mapped = [_folder(channel) for column, channel in found.items() if column != "time"]
    if mapped:
        return next((folder for folder in mapped if folder in loops), None)
    if len(loops) > 1:
        first = next(iter(loops.values()))
        raise Unusable(
            f"the file has the loops {', '.join(loops)}; choose one by its measurement, as in "
            f"{option('measurement', first.name)}"
        )
    return next(iter(loops), None)


def _folder(channel: Channel) -> str:
    parted = _FOLDER.match(channel.name)
    return parted["folder"] if parted else ""


def _loops(channels: Sequence[Channel]) -> dict[str, Channel]:
    """The measurement of each folder of channels in which there is a setpoint, too."""
    folders: dict[str, list[Channel]] = {}
    for channel in channels:
        folders.setdefault(_folder(channel), []).append(channel)
    loops = {}
    for folder, inside in folders.items():
        try:
            setpoint = by_usual_name(inside, "setpoint", SETPOINTS)
            measured = by_usual_name(
                [c for c in inside if c is not setpoint], "measurement", MEASUREMENTS
            )
        except Unusable:
            continue
        if setpoint is not None and measured is not None:
            loops[folder] = measured
    return loops
