"""Trial records as files for other programs: CSV with JSON beside it, or Parquet.

The files are copies of the journal. Each is written under a temporary name and renamed, so that a
reader never sees a partial file.
"""

import csv
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput, JournalError
from estune.run.journal import Journal
from estune.trial import TrialRecord

_REQUIRED = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad")

Format = Literal["csv", "parquet"]


def columns(record: TrialRecord) -> dict[str, Any]:
    """The columns of a record by name, each of shape (samples,); `reference_N` if there is one."""
    shown: dict[str, Any] = {name: getattr(record, name) for name in _REQUIRED}
    if record.reference_N is not None:
        shown["reference_N"] = record.reference_N
    return {**shown, "flags": record.flags}


def metadata(record: TrialRecord) -> dict[str, Any]:
    """All fields of a record but its columns, as JSON values."""
    return {
        "rig": record.rig,
        "trial_id": record.trial_id,
        "sampling_Hz": record.sampling_Hz,
        "cable_length_m": record.cable_length_m,
        "preload_N": record.preload_N,
        "loop": record.loop,
        "gains": dict(zip(GAIN_NAMES, record.gains.as_tuple(), strict=True)),
        "profile": record.profile,
        "outcome": record.outcome.value,
        "reason": record.reason,
        "started_at": record.started_at,
        "software": record.software,
    }


def export_run(run_folder: Path, out: Path, form: Format) -> list[Path]:
    """Writes every record of a run, one file per trial.

    Args:
        run_folder: The run.
        out: Folder for the files; made if it is missing. Files of the same trials are replaced.
        form: `csv`, with the metadata in `<trial id>.json` beside it, or `parquet`, with the
            metadata as JSON under the key `estune` of the file's own metadata.

    Returns:
        The files with the columns, in the order of the trials.

    Raises:
        InvalidInput: Parquet is requested and pyarrow is not installed.
        JournalError: the run cannot be read, or a file cannot be written.
    """
    write = _to_csv if form == "csv" else _parquet_writer()
    written = []
    with Journal.open(run_folder) as journal, _explained(out):
        out.mkdir(parents=True, exist_ok=True)
        for entry in journal.entries():
            if entry.outcome is not None:
                record = journal.record(entry.trial_id)
                written.append(write(record, out / record.trial_id))
    return written


def write_record(record: TrialRecord, folder: Path) -> Path:
    """Writes one record as CSV, with its metadata as JSON beside it; the path of the CSV.

    Raises:
        JournalError: a file cannot be written.
    """
    with _explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        return _to_csv(record, folder / record.trial_id)


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file completely or not at all."""
    with _whole(path) as temporary:
        temporary.write_bytes(content)


def write_file(path: Path, content: bytes) -> None:
    """Writes a file of the user's choice completely or not at all.

    Raises:
        InvalidInput: it cannot be written.
    """
    try:
        replace_file(path, content)
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another file") from error


def _to_csv(record: TrialRecord, stem: Path) -> Path:
    shown = columns(record)
    beside = stem.with_name(f"{stem.name}.json")
    replace_file(beside, json.dumps(metadata(record), indent=2, allow_nan=False).encode())
    path = stem.with_name(f"{stem.name}.csv")
    with _whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(shown)
        # Python writes the shortest text that reads back as the same number.
        writer.writerows(
            zip(*(np.asarray(column).tolist() for column in shown.values()), strict=True)
        )
    return path


def _parquet_writer() -> Callable[[TrialRecord, Path], Path]:
    try:
        import pyarrow as pa  # noqa: PLC0415  an optional dependency, slow to import
        from pyarrow import parquet  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise InvalidInput(
            "Parquet needs pyarrow; install it with: pip install 'estune[parquet]', or export CSV"
        ) from error

    def write(record: TrialRecord, stem: Path) -> Path:
        path = stem.with_name(f"{stem.name}.parquet")
        about = json.dumps(metadata(record), allow_nan=False)
        table = pa.table(columns(record)).replace_schema_metadata({"estune": about})
        with _whole(path) as temporary:
            parquet.write_table(table, temporary)
        return path

    return write


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A temporary file beside the path, renamed to it at the end of the block."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _explained(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise JournalError(
            f"{error.filename or out}: {error.strerror or error}; choose another folder"
        ) from error
