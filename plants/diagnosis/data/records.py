"""Reads a folder of records: CSV with JSON beside it, Parquet, or a run's journal."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, JournalError
from estune.run.journal import FILE_NAME, Journal
from plants.diagnosis.data.measured_record import (
    CHANNELS,
    OUTPUTS,
    ROUNDING,
    DataIssue,
    MeasuredRecord,
    Unusable,
)
from plants.diagnosis.data.table import READERS, Table, read_table
from plants.diagnosis.data.timing import sampling_rate

FEWEST_SAMPLES = 3
"""Fewer rows have no sampling rate."""


class FolderContents(NamedTuple):
    """The usable records of a folder by name, and the issues file by file."""

    measurements: tuple[MeasuredRecord, ...]
    findings: tuple[DataIssue, ...]


def read_measurements(folder: Path | str) -> FolderContents:
    """Reads every record below a folder, or a single file; one bad file does not cost the others.

    Args:
        folder: Holds `.csv` files with `.json` of the same name beside them, `.parquet` files,
            runs of estune, or folders with any of these.

    Raises:
        InvalidInput: there is no record, or none that can be used; the message lists why.
    """
    folder = Path(folder)
    if not folder.exists():
        raise InvalidInput(f"{folder} does not exist; give a folder of records")
    found: dict[str, MeasuredRecord] = {}
    findings: list[DataIssue] = []
    for result in _read_all(folder):
        if isinstance(result, DataIssue):
            findings.append(result)
        elif result.name not in found:
            found[result.name] = result
        elif _same(result, found[result.name]):
            first = found[result.name].source
            sentence = f"trial {result.name} was read from {first} already; this copy is left out"
            findings.append(DataIssue("warning", sentence, source=result.source))
        else:
            name = f"{result.name} ({result.source})"
            found[name] = replace(result, name=name)
    if not found:
        listed = "; ".join(str(f) for f in findings if f.level == "refused")
        what = listed or f"it holds no {', '.join(READERS)} or run"
        raise InvalidInput(f"{folder} has no record that can be used: {what}")
    return FolderContents(tuple(found[name] for name in sorted(found)), tuple(findings))


def _same(one: MeasuredRecord, other: MeasuredRecord) -> bool:
    columns = [(one.channel(name), other.channel(name)) for name in OUTPUTS]
    return all(
        (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))
        for a, b in columns
    )


def _read_all(folder: Path) -> Iterator[MeasuredRecord | DataIssue]:
    """Every record below the folder, or the issue that cost it."""
    for path in [folder] if folder.is_file() else sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if any(part.startswith(".") for part in inside.parts):
            continue
        source = path.name if path == folder else inside.as_posix()
        if path.name == FILE_NAME:
            yield from _read_run(path.parent, source)
        elif path.suffix in READERS and path.is_file():
            yield from _read_file(path, source)


def _read_file(path: Path, source: str) -> Iterator[MeasuredRecord | DataIssue]:
    try:
        table = read_table(path)
        measurement, issues = _measurement(table, path.stem, source)
    except Unusable as error:
        yield replace(error.issue, source=source)
        return
    for issue in (*table.issues, *issues):
        yield replace(issue, source=source)
    yield measurement


def _read_run(folder: Path, source: str) -> Iterator[MeasuredRecord | DataIssue]:
    try:
        with Journal.open(folder) as journal:
            for entry in journal.entries():
                if entry.outcome is not None:
                    yield _read_trial(journal, entry.trial_id, source)
    except JournalError as error:
        yield DataIssue("refused", str(error), source=source)


def _read_trial(journal: Journal, trial_id: str, source: str) -> MeasuredRecord | DataIssue:
    try:
        record = journal.record(trial_id)
    except JournalError as error:
        return DataIssue("refused", str(error), source=source)
    if record.time_s.size < FEWEST_SAMPLES:
        sentence = f"trial {trial_id} has {record.time_s.size} samples; nothing can be read off it"
        return DataIssue("refused", sentence, source=source)
    return replace(MeasuredRecord.of(record), source=f"{source} {trial_id}")


def _measurement(table: Table, stem: str, source: str) -> tuple[MeasuredRecord, list[DataIssue]]:
    """The measurement of a table, and warnings."""
    # A rig without a gauge or an encoder fills the column with zeros.
    columns = {k: v for k, v in table.columns.items() if k not in OUTPUTS or v.any()}
    about = _Metadata(table.metadata)
    issues: list[DataIssue] = []
    if not table.metadata:
        sentence = "there is no metadata; rate, loop and preload are read off the columns"
        issues.append(DataIssue("warning", sentence))
    if not any(name in columns for name in OUTPUTS):
        raise Unusable(
            f"there is none of the columns {', '.join(OUTPUTS)}; name what was measured"
        )
    if not {"setpoint_N", "current_A"} & set(columns):
        raise Unusable("there is neither setpoint_N nor current_A; name what was commanded")
    samples = next(iter(columns.values())).size
    if samples < FEWEST_SAMPLES:
        raise Unusable(f"the file has {samples} rows; {FEWEST_SAMPLES} or more are needed")
    sampling_Hz, time_s, warning = _time(columns, samples, about)
    if warning:
        issues.append(DataIssue("warning", warning, "time_s"))
    flags = columns.get("flags")
    measurement = MeasuredRecord(
        name=about.text("trial_id") or stem,
        rig=about.text("rig") or "",
        sampling_Hz=sampling_Hz,
        cable_length_m=about.number("cable_length_m", above=0.0),
        preload_N=_preload(about, columns),
        loop=_loop(about, columns),
        profile=about.text("profile") or "custom",
        gains=about.gains(),
        time_s=time_s,
        flags=None if flags is None else (flags.astype(np.int64) & 0xFF).astype(np.uint8),
        source=source,
        **{name: columns.get(name) for name in CHANNELS},
    )
    if measurement.loop == "closed" and measurement.current_A is None:
        raise Unusable(
            "a closed-loop record needs current_A, for the setpoint does not tell what the motor "
            "was commanded; record the current"
        )
    return measurement, issues


def _time(
    columns: dict[str, FloatArray], samples: int, about: "_Metadata"
) -> tuple[float, FloatArray, str | None]:
    """Sampling rate, time, and a warning."""
    stated_Hz, time_s = about.number("sampling_Hz", above=0.0), columns.get("time_s")
    if time_s is not None:
        sampling_Hz, warning = sampling_rate(time_s, stated_Hz)
        return sampling_Hz, time_s, warning
    if stated_Hz is None:
        raise Unusable("there is neither time_s nor sampling_Hz; give one of them")
    warning = "there is no time column; it is made from sampling_Hz"
    return stated_Hz, np.arange(samples) / stated_Hz, warning


def _preload(about: "_Metadata", columns: dict[str, FloatArray]) -> float:
    """As stated, or the first setpoint or tension."""
    stated = about.number("preload_N")
    if stated is not None:
        return stated
    first = columns.get("setpoint_N", columns.get("tension_N"))
    return 0.0 if first is None else float(first[0])


def _loop(about: "_Metadata", columns: dict[str, FloatArray]) -> Literal["open", "closed"]:
    """As stated, or open where the current is the setpoint times a constant."""
    stated = about.text("loop")
    if stated == "open":
        return "open"
    if stated == "closed":
        return "closed"
    if stated is not None:
        raise Unusable(f"loop is {stated!r} in the metadata; it is open or closed")
    current, setpoint = columns.get("current_A"), columns.get("setpoint_N")
    if current is None or setpoint is None:
        return "open" if current is None else "closed"
    power = float(setpoint @ setpoint)
    ratio = float(current @ setpoint) / power if power > 0.0 else 0.0
    apart = float(np.abs(current - ratio * setpoint).max())
    return "open" if apart <= ROUNDING * float(np.abs(current).max()) else "closed"


class _Metadata(NamedTuple):
    """The metadata, as other programs may write them."""

    values: dict[str, Any]

    def number(self, name: str, above: float = -math.inf) -> float | None:
        """A finite number, or None where it is missing or null."""
        value = self.values.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise Unusable(f"{name} is {value!r} in the metadata; give a number")
        if not (math.isfinite(value) and value > above):
            raise Unusable(f"{name} is {value} in the metadata; give a finite number in range")
        return float(value)

    def text(self, name: str) -> str | None:
        """A text, or None where it is missing or null."""
        value = self.values.get(name)
        return None if value is None else str(value)

    def gains(self) -> Gains | None:
        """The controller's gains, or None where they are not known."""
        value = self.values.get("gains")
        if not isinstance(value, dict):
            return None
        try:
            return Gains(*(value[name] for name in ("P", "I", "D", "setpoint_filter_s")))
        except (KeyError, TypeError, InvalidInput):
            return None
