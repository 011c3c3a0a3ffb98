"""Trial records of a run as files for other programs: one pair for a whole run, or per trial.

`samples` holds the samples of all trials of a run one after the other, `trials` a row for each
trial with everything else. The files are copies of the journal. Each is written under a temporary
name and renamed, so that a reader never sees a partial file.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput, JournalError
from estune.recordings.record_files import RecordFormat, check_library, write_columns
from estune.run.journal import Journal, JournalEntry
from estune.run.planning import description_from_json
from estune.run.table_file import Append, csv_table, parquet_table
from estune.trial import OPTIONAL_COLUMNS, TrialRecord
from estune.trial.signals import REEL, Signals

_REQUIRED = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad")

OnTrial = Callable[[int, int], None]
"""Called after each trial with the number of trials done, and of all."""

_TRIAL_COLUMNS = (
    *("number", "attempt", "trial_id", "phase", *GAIN_NAMES, "outcome", "reason", "cost"),
    *("samples", "rig", "sampling_Hz", "cable_length_m", "preload_N", "loop", "profile"),
    *("started_at", "software"),
)


def columns(record: TrialRecord) -> dict[str, Any]:
    """The columns of a record by name, each of shape (samples,)."""
    shown: dict[str, Any] = {name: getattr(record, name) for name in _REQUIRED}
    return {**shown, **record.optional_columns, "flags": record.flags}


def metadata(record: TrialRecord, signals: Signals = REEL) -> dict[str, Any]:
    """All fields of a record but its columns, as JSON values; names of signals but a reel's."""
    return signals.stated | {
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


def export_run(
    run_folder: Path, out: Path, form: RecordFormat, on_trial: OnTrial = lambda _done, _all: None
) -> tuple[Path, Path]:
    """Writes every trial of a run into two files, `samples` and `trials`.

    Args:
        out: Folder for the files; made if it is missing. Earlier files are replaced.
        form: `csv` or `parquet`.
        on_trial: Called after each trial with the number of trials done, and of all.

    Returns:
        The two files.

    Raises:
        InvalidInput: the format is MCAP, or its library is not installed.
        JournalError: the run cannot be read, or a file cannot be written.
    """
    begin: Callable[[Path, tuple[str, ...]], AbstractContextManager[Append]] = csv_table
    if form == "mcap":
        raise InvalidInput("MCAP is written trial by trial; add --per-trial")
    check_library(form)
    if form == "parquet":
        begin = parquet_table
    paths = out / f"samples.{form}", out / f"trials.{form}"
    with Journal.open(run_folder) as journal, _explained(out), ExitStack() as stack:
        out.mkdir(parents=True, exist_ok=True)
        entries = [entry for entry in journal.entries() if entry.outcome is not None]
        stored = journal.stored_trial_ids()
        names = _sample_columns(*(journal.record(trial_id) for trial_id in stored[:1]))
        samples = stack.enter_context(begin(paths[0], names))
        trials = stack.enter_context(begin(paths[1], _TRIAL_COLUMNS))
        for done, entry in enumerate(entries, start=1):
            record = journal.record(entry.trial_id) if entry.trial_id in stored else None
            if record is not None:
                samples(_samples_of(entry, record, names))
            trials({name: [value] for name, value in _trial_of(entry, record).items()})
            on_trial(done, len(entries))
    return paths


def export_trials(
    run_folder: Path, out: Path, form: RecordFormat, on_trial: OnTrial = lambda _done, _all: None
) -> list[Path]:
    """Writes every record of a run, one file per trial; `export_run` writes fewer.

    Args:
        out: Folder for the files; made if it is missing. Files of the same trials are replaced.
        form: As of `record_files.write_columns`.
        on_trial: As of `export_run`.

    Returns:
        The files with the columns, in the order of the trials.

    Raises:
        InvalidInput: the library of the format is not installed.
        JournalError: the run cannot be read, or a file cannot be written.
    """
    check_library(form)
    written: list[Path] = []
    with Journal.open(run_folder) as journal, _explained(out):
        out.mkdir(parents=True, exist_ok=True)
        stored = journal.stored_trial_ids()
        signals = description_from_json(journal.fact("rig")).signals
        for trial_id in stored:
            written.append(_write(journal.record(trial_id), out, form, signals))
            on_trial(len(written), len(stored))
    return written


def write_record(record: TrialRecord, folder: Path) -> Path:
    """Writes one record as CSV, with its metadata as JSON beside it; the path of the CSV.

    Raises:
        JournalError: a file cannot be written.
    """
    with _explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        return _write(record, folder, "csv")


def _write(record: TrialRecord, folder: Path, form: RecordFormat, signals: Signals = REEL) -> Path:
    return write_columns(
        columns(record), metadata(record, signals), folder / record.trial_id, form
    )


def _sample_columns(*first: TrialRecord) -> tuple[str, ...]:
    """Columns of the samples of a run, by its first record: `reference_N` is always there."""
    present = {"reference_N", *(name for record in first for name in record.optional_columns)}
    optional = (name for name in OPTIONAL_COLUMNS if name in present)
    return ("number", "attempt", *_REQUIRED, *optional, "flags")


def _samples_of(
    entry: JournalEntry, record: TrialRecord, names: tuple[str, ...]
) -> dict[str, Sequence[Any]]:
    """The samples of a trial as columns, with the place of the trial in each row."""
    rows = len(record.time_s)
    place = {name: np.full(rows, getattr(entry, name)) for name in ("number", "attempt")}
    present = {**place, **columns(record)}
    return {name: present.get(name, [None] * rows) for name in names}


def _trial_of(entry: JournalEntry, record: TrialRecord | None) -> dict[str, Any]:
    """The row of a trial; without its record, only what the journal keeps for ever."""
    row = dict.fromkeys(_TRIAL_COLUMNS)
    if record is not None:
        row |= {name: value for name, value in metadata(record).items() if name in row}
        row["samples"] = len(record.time_s)
    gains = dict(zip(GAIN_NAMES, entry.gain_values, strict=True))
    kept = {name: getattr(entry, name) for name in ("number", "attempt", "trial_id", "reason")}
    cost = entry.cost if math.isfinite(entry.cost) else None
    ending = {"phase": str(entry.phase), "outcome": str(entry.outcome), "cost": cost}
    return {**row, **kept, **gains, **ending}


@contextmanager
def _explained(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise JournalError(
            f"{error.filename or out}: {error.strerror or error}; choose another folder"
        ) from error
