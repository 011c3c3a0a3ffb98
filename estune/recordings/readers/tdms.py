"""TDMS, as LabVIEW writes it: `group/channel`, with unit, start and increment of waveforms."""

from pathlib import Path
from typing import Any

import numpy as np

from estune.recordings.raw_file import Channel, RawFile


def read_tdms(path: Path) -> RawFile:
    """Reads all channels; properties of the file are metadata."""
    from nptdms import TdmsFile  # noqa: PLC0415  an optional dependency

    file = TdmsFile.read(path)
    found = [channel for group in file.groups() for channel in group.channels()]
    begun = [c.properties["wf_start_time"] for c in found if "wf_start_time" in c.properties]
    channels = tuple(_channel(channel, min(begun, default=None)) for channel in found)
    return RawFile(channels, {name: _plain(value) for name, value in file.properties.items()})


def _channel(channel: Any, begun: Any) -> Channel:
    """A channel; the stamps of a waveform count from the earliest one's start."""
    values, properties = channel[:], channel.properties
    time_s = None
    if "wf_increment" in properties:
        begin_s = 0.0
        if "wf_start_time" in properties:
            begin_s = float((properties["wf_start_time"] - begun) / np.timedelta64(1, "s"))
        begin_s += properties.get("wf_start_offset", 0.0)
        time_s = begin_s + properties["wf_increment"] * np.arange(len(values))
    unit = str(properties.get("unit_string", ""))
    return Channel(f"{channel.group_name}/{channel.name}", values, unit, time_s)


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value
