"""One record as a file for other programs: CSV with JSON beside it, Parquet, or MCAP."""

import csv
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from estune.errors import InvalidInput
from estune.support.whole_file import whole_file

RecordFormat = Literal["csv", "parquet", "mcap"]

_LIBRARIES = {"parquet": "pyarrow", "mcap": "mcap"}


def write_columns(
    columns: Mapping[str, Any], metadata: Mapping[str, Any], stem: Path, form: RecordFormat
) -> Path:
    """Writes one record; each file completely or not at all.

    Args:
        columns: Columns by name, each of shape (samples,).
        metadata: Everything else, as JSON values.
        stem: The path without its ending.
        form: `csv`, with the metadata in a `.json` beside it; `parquet`, with them as JSON under
            the key `estune` of the file's own metadata; `mcap`, a JSON message for each sample,
            with them in a metadata record `estune`.

    Returns:
        The file with the columns.

    Raises:
        InvalidInput: the library of the format is not installed.
    """
    path = stem.with_name(f"{stem.name}.{form}")
    about = json.dumps(metadata, indent=2, allow_nan=False)
    if form == "csv":
        with whole_file(stem.with_name(f"{stem.name}.json")) as temporary:
            temporary.write_text(about, "utf-8")
    write = {"csv": _csv, "parquet": _parquet, "mcap": _mcap}[form]
    check_library(form)
    with whole_file(path) as temporary:
        write(columns, metadata, temporary)
    return path


def check_library(form: RecordFormat) -> None:
    """Checks that the library of a format is installed.

    Raises:
        InvalidInput: it is not.
    """
    from importlib.util import find_spec  # noqa: PLC0415  of no use to CSV

    library = _LIBRARIES.get(form)
    if library is not None and find_spec(library) is None:
        raise InvalidInput(
            f"{form} files need {library}; install it with: pip install 'estune[{form}]', or "
            "export CSV"
        )


def _csv(columns: Mapping[str, Any], _metadata: Mapping[str, Any], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        # Python writes the shortest text that reads back as the same number.
        writer.writerows(zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True))


def _parquet(columns: Mapping[str, Any], metadata: Mapping[str, Any], path: Path) -> None:
    import pyarrow as pa  # noqa: PLC0415  an optional dependency, slow to import
    from pyarrow import parquet  # noqa: PLC0415

    about = json.dumps(metadata, allow_nan=False)
    parquet.write_table(pa.table(dict(columns)).replace_schema_metadata({"estune": about}), path)


def _mcap(columns: Mapping[str, Any], metadata: Mapping[str, Any], path: Path) -> None:
    from mcap.writer import Writer  # noqa: PLC0415  an optional dependency

    begun = metadata.get("started_at")
    begin = datetime.fromisoformat(begun) if begun else datetime.fromtimestamp(0, UTC)
    begin_ns = round(begin.timestamp() * 1e9)
    properties = {name: {"type": "number"} for name in columns}
    schema = {"type": "object", "properties": properties}
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    with path.open("wb") as file:
        writer: Any = Writer(file, enable_data_crcs=True)
        writer.start(library="estune")
        schema_id = writer.register_schema("estune.Sample", "jsonschema", _bytes(schema))
        topic = f"/{metadata.get('rig') or 'rig'}/record"
        channel = writer.register_channel(topic, "json", schema_id)
        for number, (row, time_s) in enumerate(zip(rows, columns["time_s"], strict=True)):
            now = begin_ns + round(float(time_s) * 1e9)
            sample = dict(zip(columns, row, strict=True))
            writer.add_message(channel, now, _bytes(sample), now, number)
        writer.add_metadata("estune", {"record": json.dumps(metadata, allow_nan=False)})
        writer.finish()


def _bytes(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
