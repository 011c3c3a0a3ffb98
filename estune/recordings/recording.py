"""One file of recorded data as the columns of a record, in SI units on an even grid."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.channel_search import (
    EFFORTS,
    JOINT_POSITIONS,
    JOINT_TORQUES,
    MEASUREMENTS,
    SETPOINTS,
    TIMES,
    by_usual_name,
    find_channel,
    option,
)
from estune.recordings.column_map import (
    AS_NAMED,
    ColumnMap,
    ColumnTable,
    Mapped,
    is_bare,
    is_own_unit,
    map_column,
)
from estune.recordings.column_names import (
    MEASURED,
    METADATA,
    SYNONYMS,
    TABLE_COLUMNS,
    suggest_name,
)
from estune.recordings.heading import heading, nearest
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.long_form import separated
from estune.recordings.metadata import Metadata, metadata_beside
from estune.recordings.raw_file import Channel, RawFile, read_raw
from estune.recordings.time_unit import time_doubt
from estune.recordings.timing import Columns, evened, resampled
from estune.recordings.units import NO_DRUM, Drum
from estune.trial.records import COMPENSATION_COLUMNS

RATE = "speed_rad_s"
FEWEST_SAMPLES = 3
"""Fewer rows have no sampling rate."""
_LISTED = 12
"""Channels that a message lists."""


class Recording(NamedTuple):
    """Contents of a file.

    Attributes:
        parts: Columns of each stretch without a gap; `time_s` is one of them, and beside an angle
            that is the integral of a speed that one, as `RATE`.
        metadata: As written in the file, beside it or in the map.
        mapped: Where each column came from.
        issues: Channels that were ignored, and what was done to the time stamps.
    """

    sampling_Hz: float
    parts: tuple[Columns, ...]
    metadata: Metadata
    mapped: dict[str, Mapped]
    issues: tuple[DataIssue, ...]


def read_recording(
    path: Path, column_map: ColumnMap = AS_NAMED, drum: Drum = NO_DRUM
) -> Recording:
    """Reads a file of a known format and the `.json` beside it.

    Args:
        column_map: Names, units and scales of the columns that are not as a record's.
        drum: Numbers of the reel, for lengths and torques.

    Raises:
        Unusable: it cannot be read, or is no record; the message is one line.
    """
    raw = separated(read_raw(path))
    metadata = Metadata({**column_map.record, **(raw.metadata or metadata_beside(path))})
    mapped, issues = _mapped(raw, column_map, drum)
    _check_names(frozenset(metadata.values), METADATA)
    columns = {n: m for n, m in mapped.items() if n != "time_s"}
    # A rig without a gauge or an encoder fills the column with zeros.
    columns = {n: m for n, m in columns.items() if n not in MEASURED or m.values.any()}
    _check_present(columns, raw)
    stated_Hz = metadata.number("sampling_Hz", above=0.0)
    clocks, warning = _clocks(columns, mapped.get("time_s"), stated_Hz)
    values = {name: m.values for name, m in columns.items()}
    one = next(iter(clocks.values()))
    if all(clock is one or np.array_equal(clock, one) for clock in clocks.values()):
        grid = evened(values, one, stated_Hz)
    else:
        grid = resampled(values, clocks, stated_Hz)
    rates = [name for name in columns if mapped[name].is_rate]
    parts = tuple(
        {**p, **{n: c for name in rates for n, c in _integrated(name, p, grid.sampling_Hz)}}
        for p in grid.parts
        if p["time_s"].size >= FEWEST_SAMPLES
    )
    warning += [_said_of_rate(name, mapped[name]) for name in rates]
    if not parts:
        few = f"no {FEWEST_SAMPLES} samples in a row are without a gap"
        raise Unusable(f"{few}; record the stamps of the device", "time_s")
    return Recording(grid.sampling_Hz, parts, metadata, mapped, (*issues, *warning, *grid.issues))


def _integrated(name: str, part: Columns, sampling_Hz: float) -> Iterator[tuple[str, FloatArray]]:
    """A column from its rate by the trapezoidal rule, from zero on, and the rate itself."""
    rate = part[name]
    areas = 0.5 * (rate[1:] + rate[:-1]) / sampling_Hz
    yield name, np.concatenate([[0.0], np.cumsum(areas)])
    yield RATE, rate


def _said_of_rate(name: str, found: Mapped) -> DataIssue:
    said = f"{found.source} is in {found.unit}, a speed, and integrated; its noise adds up"
    return DataIssue("warning", f"{said}: record the position where a sensor has it", name)


def _mapped(
    raw: RawFile, column_map: ColumnMap, drum: Drum
) -> tuple[dict[str, Mapped], list[DataIssue]]:
    mapped, issues = {}, list[DataIssue]()
    for name in TABLE_COLUMNS:
        table = column_map.table(name)
        channel = _channel(raw, name, table)
        if channel is None:
            continue
        try:
            found = map_column(name, table, channel, drum)
        except Unusable:
            if table.from_ or channel.name.endswith(name):
                raise
            continue  # of another quantity: it is named below as one that is ignored
        if found is None:
            sentence = "the column is empty; it is taken as missing"
            issues.append(DataIssue("warning", sentence, name))
        else:
            mapped[name] = found
            issues += _by_name(name, table, channel, found, drum)
    issues += _by_usual_names(raw, mapped, drum)
    used = {m.source for m in mapped.values()}
    left = frozenset(c.name for c in raw.channels) - used
    present = left | mapped.keys()
    known = TABLE_COLUMNS if not column_map.column else ()  # a map says what is meant
    return mapped, issues + _check_names(present, known, used)


def _channel(raw: RawFile, name: str, table: ColumnTable) -> Channel | None:
    """The channel of a column: that of the map, or of its name with its unit or another."""
    if table.from_:
        found = find_channel(table.from_, raw.channels, name)
        if found is None:
            raise Unusable(f"there is no {table.from_}; {_listed(raw)}", name)
        return found
    exact = [c for c in raw.channels if c.name == name]
    tails = exact or [c for c in raw.channels if c.name.endswith((f".{name}", f"/{name}"))]
    if len(tails) > 1:
        return find_channel(name, tails, name)
    if tails:
        return tails[0]
    if name == "time_s":
        return by_usual_name(raw.channels, "time", TIMES)
    others = {word for word, of in SYNONYMS.items() if of == name}
    named = list[Channel]()
    for stems in ({name.partition("_")[0]}, others):
        named = named or [c for c in raw.channels if heading(c.name).key in stems]
    return named[0] if len(named) == 1 else None


_OF_PLANT = (
    ("setpoint_N", "setpoint", "setpoint", SETPOINTS),
    ("tension_N", "output", "measurement", MEASUREMENTS),
    ("current_A", "input", "effort", EFFORTS),
)
_OF_DRIVE = (
    ("angle_rad", "position", "measurement", JOINT_POSITIONS + MEASUREMENTS),
    ("current_A", "torque", "effort", JOINT_TORQUES + EFFORTS),
)
"""Columns of a record, their names in a map, and in a loop's log, and those in files."""


def _by_usual_names(raw: RawFile, mapped: dict[str, Mapped], drum: Drum) -> list[DataIssue]:
    """What a plant or a drive measures and is commanded, by the usual names, added to the mapped.

    Only where nothing measured was found otherwise; it is said, for a name may mislead.
    """
    issues = list[DataIssue]()
    if any(name in mapped for name in MEASURED):
        return issues
    wanted = _OF_PLANT if drum.radius_m is None else _OF_DRIVE
    for name, word, kind, usual in wanted:
        taken = {m.source for m in mapped.values()}
        left = [c for c in raw.channels if c.name not in taken]
        channel = None if name in mapped else by_usual_name(left, kind, usual)
        found = None
        with suppress(Unusable):  # of another quantity
            found = channel and map_column(name, ColumnTable(), channel, drum)
        if channel and found:
            mapped[name] = found
            said = f"{channel.name} is taken as the {word}"
            other = f"--map {word}=NAME names another"
            issues.append(DataIssue("warning", f"{said}; {other}", name))
    return issues


def _by_name(
    name: str, table: ColumnTable, channel: Channel, found: Mapped, drum: Drum
) -> list[DataIssue]:
    """What is said of a unit that only the channel's name states, or nobody."""
    stem, _, si = name.partition("_")
    if name == "time_s":
        doubt = time_doubt(channel.name, channel.values, found.values)
        return [doubt] if doubt and is_bare(table, channel) and channel.time_s is None else []
    if found.unit in ("", "counts", si):
        if si and not table.from_ and is_bare(table, channel):
            own = drum.radius_m is None and heading(channel.name).key in SYNONYMS
            as_read = "in the unit of the model" if own else f"as {si}"
            said = f"{channel.name} has no unit and is read {as_read}"
            return [DataIssue("warning", f"{said}; give --unit {stem}=UNIT if it is not", name)]
        return []
    if is_own_unit(name, found.unit, drum):
        said = f"{channel.name} is in {found.unit} and taken as it is, in units of the plant's own"
        return [DataIssue("warning", said, name)]
    if table.unit or channel.unit:
        return []
    said = f"{channel.name} is taken to be in {found.unit}, by its name"
    return [DataIssue("warning", f"{said}; give --unit {stem}={si} if it is not", name)]


def _check_names(
    present: frozenset[str], known: tuple[str, ...], used: frozenset[str] | set[str] = frozenset()
) -> list[DataIssue]:
    """Refuses what seems to be a known name misspelt; other unknown names are ignored."""
    issues = []
    others = {*known, *used, *TABLE_COLUMNS, *COMPENSATION_COLUMNS}
    for name in sorted(present - others):
        sentence = suggest_name(name, present, known)
        if sentence is not None:
            raise Unusable(sentence, name)
        sentence = "not a column of a record; it is ignored"
        issues.append(DataIssue("warning", sentence, name))
    return issues


def _check_present(columns: dict[str, Mapped], raw: RawFile) -> None:
    if not any(name in columns for name in MEASURED):
        raise Unusable(
            f"there is none of the columns {', '.join(MEASURED)}; {_listed(raw)}: name what was "
            "measured, the output of a plant, the angle or position of a drive or the tension of "
            f"a cable, as in {option('output', _nearest(raw, columns, *MEASUREMENTS))}; a speed "
            "is integrated, as in --map angle=NAME --unit angle=rad/s"
        )
    if not {"setpoint_N", "current_A"} & set(columns):
        raise Unusable(
            f"there is neither setpoint_N nor current_A; {_listed(raw)}: name what was commanded, "
            f"as in {option('input', _nearest(raw, columns, 'current', 'command', *EFFORTS))}"
        )
    for name, m in columns.items():
        if m.values.size < FEWEST_SAMPLES:
            what = f"the file has {m.values.size} rows"
            raise Unusable(f"{what}; record {FEWEST_SAMPLES} or more", name)


def _nearest(raw: RawFile, columns: dict[str, Mapped], *names: str) -> str:
    """The free channel whose name is nearest to some names."""
    taken, times = {m.source for m in columns.values()}, {name.replace(" ", "") for name in TIMES}
    left = [c.name for c in raw.channels if heading(c.name).key not in times]
    free = [name for name in left if name not in taken] or left
    return next(iter(nearest(names, free)), "NAME")


def _listed(raw: RawFile) -> str:
    names = [f"{c.name}{'' if _has_values(c) else ' (no value but zero)'}" for c in raw.channels]
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"the file has {', '.join(names[:_LISTED])}{more}"


def _has_values(channel: Channel) -> bool:
    """Whether a channel has a value other than zero; a sensor that is absent fills in zeros."""
    return any(value == value and value not in (0, "", None) for value in channel.values)  # noqa: PLR0124  NaN is no value


def _clocks(
    columns: dict[str, Mapped], time: Mapped | None, stated_Hz: float | None
) -> tuple[dict[str, FloatArray], list[DataIssue]]:
    """Stamps of each column: those of the time column where it shares its rows, else its own."""
    clocks: dict[str, FloatArray] = {}
    issues: list[DataIssue] = []
    for name, m in columns.items():
        shares = time is not None and (
            m.time_s is None or (time.time_s is not None and np.array_equal(m.time_s, time.time_s))
        )
        own = time.values if shares and time is not None else m.time_s
        if own is None:
            if stated_Hz is None:
                raise Unusable(
                    "there is neither time_s nor sampling_Hz; name the time, as in --map "
                    "time=NAME, or give the rate in the metadata"
                )
            if not issues:
                sentence = "there is no time column; it is made from sampling_Hz"
                issues.append(DataIssue("warning", sentence, "time_s"))
            own = np.arange(m.values.size) / stated_Hz
        if own.size != m.values.size:
            raise Unusable(
                f"it has {m.values.size} values, the time {own.size}; record both together", name
            )
        clocks[name] = own
    if len({c.size for c in clocks.values()}) > 1 and issues:
        raise Unusable("the columns are of different lengths; give a time column")
    return clocks, issues
