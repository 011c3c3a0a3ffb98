"""One file of a record: its columns as arrays of numbers and its metadata, CSV or Parquet."""

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.column_names import METADATA, TABLE_COLUMNS, suggest_name
from plants.diagnosis.data.measured_record import DataIssue, Unusable

if TYPE_CHECKING:
    import pandas as pd

PARQUET_KEY = b"estune"
"""Key of a Parquet file's own metadata under which the record's stands as JSON."""


class Table(NamedTuple):
    """What a file holds.

    Attributes:
        columns: Known columns by name, finite, shape (samples,).
        metadata: As written; empty where there is none.
        issues: Columns that were ignored.
    """

    columns: dict[str, FloatArray]
    metadata: dict[str, Any]
    issues: tuple[DataIssue, ...]


def read_table(path: Path) -> Table:
    """Reads a file with an ending in `READERS` and the `.json` beside it.

    Raises:
        Unusable: it cannot be read, has no usable columns, or a column holds what is no number.
    """
    try:
        names, frame, metadata = READERS[path.suffix](path)
        beside = path.with_name(f"{path.stem}.json")
        if not metadata and beside.is_file():
            metadata = _as_object(beside.read_bytes(), beside.name)
    except OSError as error:
        raise Unusable(f"{error.strerror or error}; check the file") from error
    except UnicodeDecodeError as error:
        raise Unusable("the file is no UTF-8 text; save it as UTF-8") from error
    if frame.shape[0] == 0:
        raise Unusable("the file has no rows; record the trial again or remove the file")
    issues = _check_names(names, TABLE_COLUMNS)
    _check_names(frozenset(metadata), METADATA)
    columns = {}
    for name in (known for known in TABLE_COLUMNS if known in names):
        values = _numbers(name, frame[name])
        if values is None:
            sentence = "the column is empty; it is taken as missing"
            issues.append(DataIssue("warning", sentence, name))
        else:
            columns[name] = values
    return Table(columns, metadata, tuple(issues))


def _read_csv(path: Path) -> tuple[frozenset[str], "pd.DataFrame", dict[str, Any]]:
    import pandas as pd  # noqa: PLC0415  slow to import

    with path.open(encoding="utf-8-sig") as file:
        head = file.readline()
    if not head.strip():
        raise Unusable("the file is empty; record the trial again or remove it")
    separator = max(",;\t", key=head.count)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                path,
                sep=separator,
                decimal="." if separator == "," else _decimal(path),
                encoding="utf-8-sig",
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
            )
    except pd.errors.ParserWarning as error:
        raise Unusable("rows have more cells than the heading; name every column") from error
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        line = re.search(r"line (\d+)", str(error))
        raise Unusable(
            "the row has more cells than the heading, or a quote is not closed; correct it",
            row=int(line[1]) - 1 if line else None,
        ) from error
    frame.columns = [str(name).strip() for name in frame.columns]
    return frozenset(frame.columns), frame, {}


def _decimal(path: Path) -> str:
    """Comma or point: with another separator than the comma, a comma can only be in a number."""
    with path.open(encoding="utf-8-sig") as file:
        file.readline()
        return "," if "," in file.readline() else "."


def _read_parquet(path: Path) -> tuple[frozenset[str], "pd.DataFrame", dict[str, Any]]:
    try:
        import pyarrow as pa  # noqa: PLC0415  an optional dependency, slow to import
        from pyarrow import parquet  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise Unusable(
            "Parquet needs pyarrow; install it with: pip install 'estune[parquet]', or export CSV"
        ) from error
    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            frame = file.read([name for name in TABLE_COLUMNS if name in schema.names]).to_pandas()
    except (pa.ArrowException, OSError) as error:
        raise Unusable("the file is truncated or no Parquet; copy or export it again") from error
    own = schema.metadata or {}
    metadata = _as_object(own[PARQUET_KEY], "its metadata") if PARQUET_KEY in own else {}
    return frozenset(schema.names), frame, metadata


def _as_object(content: bytes, source: str) -> dict[str, Any]:
    try:
        found = json.loads(content.decode("utf-8-sig"))
    except ValueError as error:
        raise Unusable(f"{source} is no JSON ({error}); correct it or remove it") from error
    if not isinstance(found, dict):
        raise Unusable(f"{source} holds no JSON object; give the metadata as one")
    return found


def _check_names(present: frozenset[str], known: tuple[str, ...]) -> list[DataIssue]:
    """Refuses what seems to be a known name misspelt; other unknown names are ignored."""
    issues = []
    for name in sorted(present - set(known)):
        sentence = suggest_name(name, present, known)
        if sentence is not None:
            raise Unusable(sentence, name)
        sentence = "not a column of a record; it is ignored"
        issues.append(DataIssue("warning", sentence, name))
    return issues


def _numbers(name: str, column: "pd.Series[Any]") -> FloatArray | None:
    """A column as floats, or None where every cell is empty."""
    import pandas as pd  # noqa: PLC0415  slow to import

    if column.isna().all():
        return None
    if not (pd.api.types.is_numeric_dtype(column) or column.dtype == object):
        column = column.astype(object)
    numeric = pd.to_numeric(column, errors="coerce")
    values: FloatArray = numeric.to_numpy(np.float64, na_value=np.nan)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        row, cell = int(bad[0]) + 1, column.iloc[int(bad[0])]
        what = "the cell is empty or NaN" if pd.isna(cell) else f"{cell!r} is not a finite number"
        more = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
        raise Unusable(f"{what}{more}; remove or correct the row", name, row)
    return values


READERS: dict[str, Callable[[Path], tuple[frozenset[str], "pd.DataFrame", dict[str, Any]]]] = {
    ".csv": _read_csv,
    ".parquet": _read_parquet,
}
"""Reader by ending; it returns the names of all columns, the known ones, and the metadata."""
