"""Step 1: records as they were logged become columns in SI units on even clocks."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estune.recordings.column_map import ColumnMap
from estune.trial import TrialRecord
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.records import FolderContents, drum_of, read_measurements

Records = Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord]


def read(records: Records, model: Any, columns: ColumnMap) -> FolderContents:
    """The measurements of a folder, or of the records themselves, with the issues of the files."""
    if isinstance(records, Path | str):
        return read_measurements(records, columns, drum_of(model))
    measured = (r if isinstance(r, MeasuredRecord) else MeasuredRecord.of(r) for r in records)
    return FolderContents(tuple(measured), ())
