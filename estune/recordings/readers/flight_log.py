"""Logs of flight controllers: PX4 (`.ulg`), ArduPilot (`.bin`) and Betaflight (CSV).

Beside the channels of the log stand its loops by name: `rate roll.setpoint`, `.measurement` and
`.effort`.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estune.recordings.raw_file import Channel, RawFile

AXES = ("roll", "pitch", "yaw")

Loops = Mapping[str, tuple[str, str, tuple[str, ...]]]
"""Setpoint, measurement and the parts of the effort of each loop."""

_PX4: Loops = {
    f"rate {axis}": (
        f"vehicle_rates_setpoint.{axis}",
        f"vehicle_angular_velocity.xyz[{k}]",
        (f"vehicle_torque_setpoint.xyz[{k}]",),
    )
    for k, axis in enumerate(AXES)
}
_ARDUPILOT: Loops = {
    f"rate {axis}": (f"RATE.{axis[0].upper()}Des", f"RATE.{axis[0].upper()}", (f"RATE.{out}",))
    for axis, out in zip(AXES, ("ROut", "POut", "YOut"), strict=True)
}
_BETAFLIGHT: Loops = {
    f"rate {axis}": (
        f"setpoint[{k}]",
        f"gyroADC[{k}]",
        tuple(f"axis{part}[{k}]" for part in "PIDF"),
    )
    for k, axis in enumerate(AXES)
}


def read_ulog(path: Path) -> RawFile:
    """Reads all topics of a PX4 log: `topic.field`, of further instances `topic:1.field`."""
    from pyulog import ULog  # noqa: PLC0415  an optional dependency

    channels = []
    with path.open("rb") as file:  # it leaves a file open that it refuses
        log = ULog(file)
    begin_us = min((int(d.data["timestamp"].min()) for d in log.data_list), default=0)
    for topic in log.data_list:
        name = topic.name + (f":{topic.multi_id}" if topic.multi_id else "")
        stamps, first = np.unique(topic.data["timestamp"].astype(np.int64), return_index=True)
        time_s = (stamps - begin_us) * 1e-6
        channels += [
            Channel(f"{name}.{field}", values[first], "", time_s)
            for field, values in topic.data.items()
            if field != "timestamp"
        ]
    return RawFile((*_loops(channels, _PX4), *channels), {})


def read_ardupilot(path: Path) -> RawFile:
    """Reads all messages with a time of an ArduPilot log: `MSG.field`."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415  an optional dependency

    rows: defaultdict[str, list[Mapping[str, Any]]] = defaultdict(list)
    log = DFReader_binary.__new__(DFReader_binary)  # so that it is closed where it refuses a file
    try:
        log.__init__(str(path))
        while (message := log.recv_msg()) is not None:
            fields = message.to_dict()
            if "TimeUS" in fields:
                rows[message.get_type()].append(fields)
    finally:
        for opened in ("data_map", "filehandle"):
            if hasattr(log, opened):
                getattr(log, opened).close()
    begin_us = min((messages[0]["TimeUS"] for messages in rows.values()), default=0)
    channels = list[Channel]()
    for kind, messages in rows.items():
        stamps, first = np.unique([m["TimeUS"] for m in messages], return_index=True)
        for field, value in messages[0].items():
            if isinstance(value, int | float) and field != "TimeUS":
                values = np.array([messages[k][field] for k in first], np.float64)
                channels.append(Channel(f"{kind}.{field}", values, "", (stamps - begin_us) * 1e-6))
    return RawFile((*_loops(channels, _ARDUPILOT), *channels), {})


def with_loops_of_betaflight(raw: RawFile) -> RawFile:
    """A decoded Betaflight log (blackbox_decode) with its loops; other tables as they are."""
    loops = _loops(raw.channels, _BETAFLIGHT)
    return raw._replace(channels=(*loops, *raw.channels)) if loops else raw


def _loops(channels: Sequence[Channel], loops: Loops) -> list[Channel]:
    """The channels of the loops whose setpoint and measurement are there."""
    named = {channel.name: channel for channel in channels}
    found = []
    for loop, (setpoint, measured, efforts) in loops.items():
        if setpoint not in named or measured not in named:
            continue
        found += [
            named[setpoint]._replace(name=f"{loop}.setpoint"),
            named[measured]._replace(name=f"{loop}.measurement"),
        ]
        parts = [named[name] for name in efforts if name in named]
        if parts:
            total = np.sum([np.asarray(part.values, np.float64) for part in parts], axis=0)
            found.append(parts[0]._replace(name=f"{loop}.effort", values=total))
    return found
