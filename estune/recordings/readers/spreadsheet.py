"""Spreadsheets: the first sheet with a table."""

from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Any

from estune.recordings.raw_file import RawFile
from estune.recordings.readers.text import table


def read_spreadsheet(path: Path) -> RawFile:
    """Reads a sheet as a table of text: lines above it and a row of units are known there."""
    from openpyxl import load_workbook  # noqa: PLC0415  an optional dependency

    with path.open("rb") as file:  # the library leaves a damaged one open
        for sheet in load_workbook(file, read_only=True, data_only=True).worksheets:
            rows = ["\t".join(map(_cell, row)) for row in sheet.iter_rows(values_only=True)]
            if len(rows) > 1:
                return table("\n".join(rows))
    return RawFile((), {})


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime | time):
        return value.isoformat(sep=" ") if isinstance(value, datetime) else value.isoformat()
    if isinstance(value, timedelta):
        return repr(value.total_seconds())
    return repr(value) if isinstance(value, float) else str(value).replace("\t", " ")
