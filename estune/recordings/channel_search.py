"""Which channel of a file is meant: by the name that a map gives, or by the usual names."""

import shlex
from collections.abc import Iterable, Mapping, Sequence

from estune.recordings.heading import heading, nearest
from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel

TIMES = (
    *("time", "t", "timestamp", "stamp", "seconds", "sec", "s", "ms", "millis", "milliseconds"),
    *("us", "micros", "microseconds", "elapsed", "elapsed time", "relative time", "uptime"),
    *("datetime", "date time", "date", "x value", "zeit", "uhrzeit", "zeitstempel"),
    *("last changed", "last updated", "time us"),
)
"""Names of the time, without unit."""

SETPOINTS = (
    *("setpoint", "sp", "reference", "ref", "target", "desired", "r", "set value", "sv", "w"),
    *("sollwert", "soll", "target temperature", "target temp", "target speed", "demand"),
    *("consigne", "führungsgröße"),
)
MEASUREMENTS = (
    *("measurement", "measured", "pv", "process value", "process variable", "actual"),
    *("feedback", "current temperature", "current temp", "tension", "temperature", "temp"),
    *("speed", "velocity", "position", "angle", "y", "rpm", "istwert", "ist", "actual value"),
    *("mesure", "regelgröße"),
)
EFFORTS = (
    *("effort", "output", "out", "op", "co", "mv", "control", "control output"),
    *("controller output", "control effort", "manipulated variable", "u", "control signal"),
    *("duty", "duty cycle", "pwm", "valve", "heater", "heater power", "power", "cv", "throttle"),
    *("stellgröße", "stellgroesse", "stellgrad", "output power", "commande"),
)
JOINT_POSITIONS = ("q", "joint position", "motor position", "encoder", "theta", "theta m", "phi")
JOINT_TORQUES = (
    "tau",
    "joint torque",
    "motor torque",
    "tau m",
    "tau j",
    "motor current",
    "iq",
    "i",
)
"""Names in the logs of robots, drives and their simulators: not of a plant, where q is a flow."""

_WORDS = {
    "setpoint": {"setpoint", "sp", "target", "desired", "reference", "demand", "sollwert", "soll"},
    "measurement": {"measured", "actual", "pv", "feedback", "estimate", "istwert", "ist"},
    "effort": {"output", "pwm", "duty", "effort", "op", "stellgröße"},
}
"""Words that mark a channel where none has one of the usual names, and one alone has a word."""

_QUANTITIES = {"temperature", "temp", "speed", "velocity", "position", "pressure", "level"}
"""Words that mark a measurement where no other word does."""


def find_channel(source: str, channels: Iterable[Channel], column: str) -> Channel | None:
    """The channel of a name as the file or a message prints it, with its unit or without.

    The end of a name, from a dot or a slash on, is enough. Where the name has a unit and the
    channel has none, it is the channel's.

    Raises:
        Unusable: several channels could be meant, or the file states another unit.
    """
    there = list(channels)
    exact = [channel for channel in there if channel.name == source]
    wanted = heading(source)
    fitting = (
        exact
        or [c for c in there if c.name.endswith(source) and _is_parted(c.name, source)]
        or [c for c in there if _same(c.name, source)]
        or [c for c in there if heading(c.name).key == wanted.key]
    )
    if not fitting:
        return None
    channel = _only(fitting, column, f"{source} could be")
    if wanted.unit and not exact and channel.unit != wanted.unit:
        own = heading(channel.name).unit
        stated = channel.unit or (own if own != wanted.unit else "")
        if stated:
            raise Unusable(
                f"{channel.name} is in {stated} by the file and in {wanted.unit} by the map; "
                "correct one",
                column,
            )
        channel = channel._replace(unit=wanted.unit)
    return channel


def _is_parted(name: str, end: str) -> bool:
    return name[: -len(end)].endswith((".", "/"))


def _same(name: str, source: str) -> bool:
    """Whether two names differ in capitals and blanks alone: with their folders."""
    return heading(name).name.casefold() == heading(source).name.casefold()


def by_usual_name(
    channels: Sequence[Channel], column: str, names: Sequence[str]
) -> Channel | None:
    """The channel with one of the usual names, the first that fits, or the only one with a word.

    Raises:
        Unusable: several could be meant.
    """
    keys = [heading(channel.name).key for channel in channels]
    for name in names:
        own = name.replace(" ", "")
        fitting = [c for c, key in zip(channels, keys, strict=True) if key == own]
        if fitting:
            return _only(fitting, column, "")
    marked = [c for c in channels if _marks(c) == {column}]
    if not marked and column == "measurement":
        marked = [c for c in channels if not _marks(c) and heading(c.name).words & _QUANTITIES]
    return _only(marked, column, "") if marked else None


def _marks(channel: Channel) -> set[str]:
    words = heading(channel.name).words
    return {column for column, marking in _WORDS.items() if words & marking}


def _only(fitting: Sequence[Channel], column: str, could: str) -> Channel:
    """The one that fits; of equal ones, as the times that some loggers repeat, the first."""
    first = fitting[0]
    if all(_equal(first, other) for other in fitting[1:]):
        return first
    listed = ", ".join(channel.name for channel in fitting[:4])
    said = f"{could} {listed}" if could else f"{listed} could each be the {column}"
    raise Unusable(f"{said}; give the whole name, as in {option(column, first.name)}", column)


def _equal(one: Channel, other: Channel) -> bool:
    return (
        one.values.shape == other.values.shape
        and one.values.dtype.kind in "biuf"
        and bool((one.values == other.values).all())
    )


def option(column: str, name: str) -> str:
    """The option that maps a column, as it is written in a shell."""
    return f"--map {shlex.quote(f'{column}={name}')}"


def not_found(column: str, channels: Sequence[Channel], names: Sequence[str]) -> str:
    """A question for the channel of a column, with the three nearest names."""
    close = nearest(names, [channel.name for channel in channels])
    return (
        f"no channel is the {column}; the nearest in the file are {', '.join(close)}: name it, "
        f"as in {option(column, close[0])}"
    )


def unused(channels: Iterable[Channel], used: Mapping[str, Channel]) -> list[Channel]:
    """Channels that no column has taken."""
    taken = {channel.name for channel in used.values()}
    return [channel for channel in channels if channel.name not in taken]
