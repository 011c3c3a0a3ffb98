"""Reads a folder of records: files of any format that is known, or a run's journal."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from estune.errors import InvalidInput, JournalError
from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.recordings.issue import DataIssue, Unusable, refusals
from estune.recordings.metadata import Metadata
from estune.recordings.raw_file import formats, is_readable
from estune.recordings.recording import FEWEST_SAMPLES, RATE, Recording, read_recording
from estune.recordings.timing import Columns
from estune.recordings.units import NO_DRUM, Drum
from estune.run.journal import FILE_NAME, Journal
from estune.trial import TrialRecord
from plants.diagnosis.data.measured_record import CHANNELS, OUTPUTS, MeasuredRecord, is_multiple

Records = Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord]


class ColumnSource(NamedTuple):
    """Origin of a column in a file: channel, unit, and factor to SI units."""

    file: str
    column: str
    channel: str
    unit: str
    factor: float


class FolderContents(NamedTuple):
    """Usable records of a folder by name, issues file by file, and where columns came from."""

    measurements: tuple[MeasuredRecord, ...]
    findings: tuple[DataIssue, ...]
    sources: tuple[ColumnSource, ...] = ()


def read(records: Records, model: Any, columns: ColumnMap) -> FolderContents:
    """The measurements of a folder, or of the records themselves, with the issues of the files."""
    if isinstance(records, Path | str):
        return read_measurements(records, columns, drum_of(model))
    measured = (r if isinstance(r, MeasuredRecord) else MeasuredRecord.of(r) for r in records)
    return FolderContents(tuple(measured), ())


def read_measurements(
    folder: Path | str, column_map: ColumnMap = AS_NAMED, drum: Drum = NO_DRUM
) -> FolderContents:
    """Reads every record below a folder, or a single file; one bad file does not cost the others.

    Args:
        folder: Holds files of the formats in `estune.recordings`, metadata in `.json` of the same
            name beside them, runs of estune, or folders with any of these.
        column_map: Where the columns come from, in files that name them otherwise.
        drum: Numbers of the reel, for lengths and torques.

    Raises:
        InvalidInput: there is no record, or none that can be used; the message lists why.
    """
    folder = Path(folder)
    if not folder.exists():
        raise InvalidInput(f"{folder} does not exist; give a folder of records")
    records: dict[str, MeasuredRecord] = {}
    findings: list[DataIssue] = []
    sources: list[ColumnSource] = []
    for result in _read_all(folder, column_map, drum):
        if isinstance(result, DataIssue):
            findings.append(result)
        elif isinstance(result, ColumnSource):
            sources.append(result)
        elif result.name not in records:
            records[result.name] = result
        elif _same(result, records[result.name]):
            first = records[result.name].source
            sentence = f"trial {result.name} was read from {first} already; this copy is left out"
            findings.append(DataIssue("warning", sentence, source=result.source))
        else:
            name = f"{result.name} ({result.source})"
            records[name] = replace(result, name=name)
    if not records:
        what = refusals(findings) or f"it holds no {', '.join(formats())} or run"
        raise InvalidInput(f"{folder} has no record that can be used: {what}")
    by_name = tuple(records[name] for name in sorted(records))
    return FolderContents(by_name, tuple(findings), tuple(sources))


def drum_of(model: Any) -> Drum:
    """The numbers of a model that turn lengths into angles and torques into currents."""
    names = ("drum_radius_m", "newtons_per_ampere")
    return Drum(*(getattr(model, name, None) for name in names))


def _same(first: MeasuredRecord, second: MeasuredRecord) -> bool:
    columns = ([np.asarray(m.channel(name)) for m in (first, second)] for name in OUTPUTS)
    return all(np.array_equal(a, b) for a, b in columns)


def _read_all(
    folder: Path, column_map: ColumnMap, drum: Drum
) -> Iterator[MeasuredRecord | DataIssue | ColumnSource]:
    for path in [folder] if folder.is_file() else sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if any(part.startswith(".") for part in inside.parts):
            continue
        source = path.name if path == folder else inside.as_posix()
        if path.name == FILE_NAME:
            yield from _read_run(path.parent, source)
        elif _is_run_export(path):
            if path.stem == "samples":
                sentence = "it is the export of a whole run; give the run, or export --per-trial"
                yield DataIssue("refused", sentence, source=source)
        elif path.is_file() and (is_readable(path) or path == folder):
            yield from _read_file(path, source, column_map, drum)


def _is_run_export(path: Path) -> bool:
    """Whether a file is one of the two that `estune export` writes for a whole run."""
    names = ("samples", "trials")
    both = path.stem in names and all(path.with_stem(name).is_file() for name in names)
    return both and path.suffix in (".csv", ".parquet")


def _read_file(
    path: Path, source: str, column_map: ColumnMap, drum: Drum
) -> Iterator[MeasuredRecord | DataIssue | ColumnSource]:
    try:
        recording = read_recording(path, column_map, drum)
        measurements = _measurements(recording, path.stem, source)
    except Unusable as error:
        yield replace(error.issue, source=source)
        return
    if not recording.metadata.values:
        sentence = "there is no metadata; rate, loop and preload are read off the columns"
        yield DataIssue("warning", sentence, source=source)
    for issue in recording.issues:
        yield replace(issue, source=source)
    for name, m in recording.mapped.items():
        yield ColumnSource(source, name, m.source, m.unit, m.factor)
    yield from measurements


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


def _measurements(recording: Recording, stem: str, source: str) -> list[MeasuredRecord]:
    about, parts = recording.metadata, recording.parts
    name = about.text("trial_id") or stem
    loop = _loop(about, parts[0])
    if loop == "closed" and "current_A" not in parts[0]:
        raise Unusable(
            "a closed-loop record needs current_A, for the setpoint does not tell what the motor "
            "was commanded; record the current"
        )
    measurements = []
    for number, columns in enumerate(parts, start=1):
        flags = columns.get("flags")
        measurements.append(
            MeasuredRecord(
                name=name if len(parts) == 1 else f"{name} part {number}",
                rig=about.text("rig") or "",
                sampling_Hz=recording.sampling_Hz,
                cable_length_m=about.number("cable_length_m", above=0.0),
                preload_N=_preload(about, columns),
                loop=loop,
                profile=about.text("profile") or "custom",
                gains=about.gains(),
                time_s=columns["time_s"],
                flags=None if flags is None else (flags.astype(np.int64) & 0xFF).astype(np.uint8),
                source=source if len(parts) == 1 else f"{source} part {number}",
                **{name: columns.get(name) for name in (*CHANNELS, RATE)},
            )
        )
    return measurements


def _preload(about: Metadata, columns: Columns) -> float:
    """As stated, or the first setpoint or tension."""
    stated = about.number("preload_N")
    if stated is not None:
        return stated
    first = columns.get("setpoint_N", columns.get("tension_N"))
    return 0.0 if first is None else float(first[0])


def _loop(about: Metadata, columns: Columns) -> Literal["open", "closed"]:
    """As stated, or closed where the current is not the setpoint times a constant.

    Without a setpoint nothing in a record shows a controller.
    """
    stated = about.text("loop")
    if stated in ("open", "closed"):
        return "open" if stated == "open" else "closed"
    if stated is not None:
        raise Unusable(f"loop is {stated!r} in the metadata; it is open or closed")
    current, setpoint = columns.get("current_A"), columns.get("setpoint_N")
    if current is None or setpoint is None:
        return "open"
    return "open" if is_multiple(current, setpoint) else "closed"
