"""Sources of a record's columns in a file: name, unit and scale, as TOML or as options."""

import difflib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.recordings.column_names import METADATA, SYNONYMS, TABLE_COLUMNS
from estune.recordings.heading import heading
from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel
from estune.recordings.time_unit import epoch_unit
from estune.recordings.units import UNITS, Drum, find_unit, si_factor
from estune.reel.calibration import CurrentCalibration, GaugeCalibration
from estune.support.file_limits import parse_json
from estune.support.toml_file import TomlTable, read_toml, validate

_OWN_UNITS = ("setpoint_N", "tension_N", "reference_N", "current_A")
"""Columns that hold input and output of any plant, in units of its own."""
RATES = ("speed", "velocity")
"""Dimensions of an angle's rate, which is integrated."""
_MECHANICAL = ("time", "force", "current", "angle", "length", "torque", "frequency")
"""Dimensions that are converted, or refused, wherever they stand."""
_NAMED_QUANTITIES = {"force": "N", "torque": "Nm", "tau": "Nm"}
"""Names that are a quantity; with a torque constant of 5 a torque was read as amperes."""
_STEMS = {name.partition("_")[0]: name for name in TABLE_COLUMNS} | SYNONYMS

_DAYS = (*("%Y/%m/%d", "%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y"), "%d.%m.%y", "%d/%m/%y", "%m/%d/%y")
_TIMES = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%I:%M:%S %p", "%I:%M %p")
DATES = ("ISO8601", *(f"{day} {time}" for day in _DAYS for time in _TIMES))
"""Forms of dates that are read."""


LARGEST = 1e50
"""Greatest value of a column, and one over the least: fourth powers stay within a float."""


class ColumnTable(TomlTable):
    """One column of the record: SI value = (value x scale + offset) in the unit.

    A calibration, the JSON of C2 or C1, turns counts into N or A instead.
    """

    from_: str = Field(default="", alias="from")
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    calibration: Path | None = Field(default=None, strict=False)


class ColumnMap(TomlTable):
    """The columns that need one, by their names in a record, and metadata the files lack."""

    column: dict[str, ColumnTable] = Field(default={})
    record: dict[str, Any] = Field(default={})

    def table(self, name: str) -> ColumnTable:
        """The map's entry for a column; an empty one for most."""
        return self.column.get(name, ColumnTable())

    def with_options(
        self, sources: Mapping[str, str], units: Mapping[str, str], scales: Mapping[str, float]
    ) -> "ColumnMap":
        """The map with sources, units and scales by column; the unit of a name may be left out.

        Raises:
            InvalidInput: there is no such column or unit.
        """
        tables = {name: table.model_dump(by_alias=True) for name, table in self.column.items()}
        given: dict[str, Mapping[str, Any]] = {"from": sources, "unit": units, "scale": scales}
        for key, values in given.items():
            for name, value in values.items():
                tables.setdefault(full_name(name), {})[key] = value
        return _checked({"column": tables, "record": self.record}, "columns")

    def save(self, path: Path) -> None:
        """Writes the map as TOML."""
        blocks = []
        for name, table in self.column.items():
            values = table.model_dump(by_alias=True, mode="json", exclude_defaults=True)
            blocks.append([f"[column.{name}]", *map(_assignment, values.items())])
        if self.record:
            blocks.append(["[record]", *map(_assignment, self.record.items())])
        path.write_text("\n\n".join("\n".join(block) for block in blocks) + "\n", "utf-8")


AS_NAMED = ColumnMap()
"""The map of files that name the columns as a record does."""


def read_column_map(path: Path) -> ColumnMap:
    """Reads a map; the calibrations it names are relative to its own folder.

    Raises:
        InvalidInput: it cannot be read, or has mistakes; the message has a line for each.
    """
    data = read_toml(path)
    for table in data.get("column", {}).values():
        if isinstance(table, dict) and isinstance(table.get("calibration"), str):
            table["calibration"] = str((path.parent / table["calibration"]).resolve())
    return _checked(data, str(path))


def full_name(name: str) -> str:
    """The name of a record's column, given with or without its unit.

    Raises:
        InvalidInput: there is no such column.
    """
    if name in TABLE_COLUMNS:
        return name
    if name not in _STEMS:
        near = difflib.get_close_matches(name, [*_STEMS, *TABLE_COLUMNS], 1)
        hint = f"did you mean {near[0]}?" if near else f"they are {', '.join(_STEMS)}"
        raise InvalidInput(f"a record has no column {name}; {hint}")
    return _STEMS[name]


def _checked(data: dict[str, Any], source: str) -> ColumnMap:
    found = validate(ColumnMap, data, source)
    for name, table in found.column.items():
        if name not in TABLE_COLUMNS:
            raise InvalidInput(f"{source}: column.{name}: write column.{full_name(name)}")
        if table.unit and find_unit(table.unit) is None:
            raise InvalidInput(_unknown_unit(table.unit, f"{source}: column.{name}.unit"))
    unknown = set(found.record) - set(METADATA)
    if unknown:
        raise InvalidInput(
            f"{source}: record has no {', '.join(sorted(unknown))}; it has {', '.join(METADATA)}"
        )
    return found


class Mapped(NamedTuple):
    """One column of a record as it was understood.

    Attributes:
        source: Name of the channel it was taken from.
        unit: Unit it was taken to be in, or `counts` of a calibration.
        factor: Factor from the values of the file to SI units.
        values: In SI units, shape (samples,).
        is_rate: Whether the values are the rate of the column, as a speed in place of an angle.
    """

    source: str
    unit: str
    factor: float
    values: FloatArray
    time_s: FloatArray | None
    is_rate: bool = False


def map_column(name: str, table: ColumnTable, channel: Channel, drum: Drum) -> Mapped | None:
    """One column in SI units; None where every cell is empty.

    Raises:
        Unusable: a cell is no number, or the unit cannot be.
    """
    values = _numbers(name, _seconds(channel.values) if name == "time_s" else channel.values)
    if values is None:
        return None
    if table.calibration is not None:
        calibrated = _calibrated(name, values, table.calibration)
        return Mapped(channel.name, "counts", np.nan, calibrated, channel.time_s)
    stem, _, si = name.partition("_")
    unit = _unit(stem, table, channel, si or "") or unit_by_name(table, channel, si, drum)
    if name == "time_s" and is_bare(table, channel):
        unit = epoch_unit(channel.values) or unit
    is_rate = name == "angle_rad" and unit in UNITS and UNITS[unit].dimension in RATES
    try:
        own = not (si and unit) or is_own_unit(name, unit, drum)
        factor = 1.0 if own else si_factor(unit, "rad/s" if is_rate else si, drum)
    except InvalidInput as error:
        raise Unusable(str(error), name) from error
    if table.scale != 1.0 or table.offset != 0.0:
        values = values * table.scale + table.offset
    if factor != 1.0:
        values = values * factor
    largest = float(np.abs(values).max(initial=0.0))
    if largest > LARGEST or 0.0 < largest < 1.0 / LARGEST:
        said = (
            f"its greatest value is {largest:.3g}, which no quantity has in {unit or 'SI units'}"
        )
        raise Unusable(f"{said}; correct its unit or scale", name)
    return Mapped(channel.name, unit, factor * table.scale, values, channel.time_s, is_rate)


def _unit(stem: str, table: ColumnTable, channel: Channel, si: str) -> str:
    """The unit of a column: the map's, else the file's; empty where neither states one."""
    given = find_unit(table.unit) if table.unit else None
    stated = find_unit(channel.unit) if channel.unit else None
    if given and stated and given != stated:
        raise Unusable(
            f"{channel.name} is in {stated} by the file and in {given} by the map; correct one",
            stem,
        )
    if channel.unit and not (given or stated) and si:
        if f"{stem}_{si}" not in _OWN_UNITS:
            raise Unusable(_unknown_unit(channel.unit, channel.name), stem)
        return channel.unit
    return given or stated or ""


def is_own_unit(name: str, unit: str, drum: Drum) -> bool:
    """Whether values are taken as they are, in a unit of the plant: that of no reel.

    So is the duty or voltage of a drive of which no torque constant is known.
    """
    known = UNITS.get(unit)
    foreign = known is None or known.dimension not in _MECHANICAL
    of_drive = name == "current_A" and drum.newtons_per_ampere == 1.0
    return foreign and name in _OWN_UNITS and (drum.radius_m is None or of_drive)


def is_bare(table: ColumnTable, channel: Channel) -> bool:
    """Whether neither the map nor the file says a unit of the channel."""
    return not (table.unit or channel.unit or heading(channel.name).unit or table.scale != 1.0)


def unit_by_name(table: ColumnTable, channel: Channel, si: str, drum: Drum) -> str:
    """The unit that a channel's name says, as `angle_deg` or `torque`, else the record's own.

    Only where nothing else says one: a scale is of values in the record's own unit.

    Args:
        table: The map's entry.
        si: The record's own unit; empty for a plain number.
        drum: Numbers of the reel, for lengths and torques.
    """
    said = heading(channel.name)
    unit = said.unit or _NAMED_QUANTITIES.get(said.key, "")
    if not unit or not si or table.scale != 1.0 or table.offset != 0.0:
        return si
    try:
        si_factor(unit, "rad/s" if si == "rad" and UNITS[unit].dimension in RATES else si, drum)
    except InvalidInput:
        return si
    return unit


def _unknown_unit(unit: str, where: str) -> str:
    return f"{where}: unit {unit!r} is not known; use one of {', '.join(UNITS)}, or a scale"


def _calibrated(name: str, counts: FloatArray, path: Path) -> FloatArray:
    try:
        stored = parse_json(path.read_text(encoding="utf-8"))
        if name == "current_A":
            return np.asarray(CurrentCalibration.from_dict(stored).current_A(counts))
        return np.asarray(GaugeCalibration.from_dict(stored).force_N(counts))
    except (OSError, ValueError, InvalidInput) as error:
        raise Unusable(f"calibration {path}: {error}; calibrate again or scale", name) from error


def _seconds(values: NDArray[Any]) -> NDArray[Any]:
    """Stamps as numbers: whole ones from the first on, dates and durations in seconds."""
    import pandas as pd  # noqa: PLC0415  slow to import

    if values.dtype == object and pd.to_numeric(pd.Series(values), errors="coerce").isna().all():
        dates = _dates(values)
        values = values if dates is None else dates
    if values.dtype.kind in "mM" and values.size and not np.isnat(values).any():
        whole = values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64)
        return np.asarray((whole - whole[0]) * 1e-9)
    if values.dtype.kind in "iu" and values.size:
        return np.asarray(values - values[0])
    return values


def _dates(texts: NDArray[Any]) -> NDArray[Any] | None:
    """Dates or times of day; None where they are neither.

    Of 02/03/2026 the day is the number with which the stamps leave the shortest gap.
    """
    import pandas as pd  # noqa: PLC0415  slow to import

    texts = pd.Series(texts).astype(str).str.replace(",", ".").to_numpy()  # of seconds

    def read(rows: NDArray[Any], form: str) -> NDArray[Any] | None:
        dates = pd.to_datetime(pd.Series(rows), format=form, errors="coerce", utc=True)
        return None if dates.isna().any() else dates.to_numpy("M8[ns]")

    forms = [form for form in DATES if read(texts[:1], form) is not None]
    dates = [stamps for form in forms if (stamps := read(texts, form)) is not None]
    if dates:
        return min(
            dates, key=lambda stamps: np.abs(np.diff(stamps.astype(np.int64))).max(initial=0)
        )
    times = pd.to_timedelta(pd.Series(texts), errors="coerce")
    return None if times.isna().any() else times.to_numpy("m8[ns]")


def _numbers(name: str, cells: NDArray[Any]) -> FloatArray | None:
    """Cells as floats, or None where every one is empty."""
    import pandas as pd  # noqa: PLC0415  slow to import

    if cells.dtype.kind == "c":
        raise Unusable("the values are complex; record real ones", name)
    column: pd.Series[Any] = pd.Series(
        cells.astype(object) if cells.dtype.kind in "mMSUO" else cells
    )
    if column.isna().all():
        return None
    values: FloatArray = pd.to_numeric(column, errors="coerce").to_numpy(
        np.float64, na_value=np.nan
    )
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        row, cell = int(bad[0]) + 1, column.iloc[int(bad[0])]
        missing = "the cell is empty or NaN"
        shown = repr(cell) if isinstance(cell, str) else str(cell)
        what = missing if column.isna().iloc[row - 1] else f"{shown} is not a finite number"
        more = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
        raise Unusable(f"{what}{more}; remove or correct the row", name, row)
    return values


def _assignment(item: tuple[str, Any]) -> str:
    key, value = item
    if isinstance(value, dict):
        return f"{key} = {{ {', '.join(map(_assignment, value.items()))} }}"
    return f"{key} = {json.dumps(value)}"
