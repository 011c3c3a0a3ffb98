"""Tables in files that are written as they grow, and appear when they are complete."""

import csv
import itertools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from estune.support.whole_file import whole_file

Column = Any
"""Values of one column: a sequence or an array."""

Append = Callable[[Mapping[str, Column]], None]
"""Appends rows to a table, given by columns."""

_INTEGERS = ("number", "attempt", "samples", "flags")
_TEXTS = (
    *("trial_id", "phase", "outcome", "reason", "rig", "loop", "profile"),
    *("started_at", "software"),
)
_BATCH_ROWS = 100_000
"""Rows that are written to a Parquet file at once."""


@contextmanager
def csv_table(path: Path, names: tuple[str, ...]) -> Iterator[Append]:
    """A CSV file with these columns."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)

        def append(table: Mapping[str, Column]) -> None:
            # Python writes the shortest text that reads back as the same number.
            columns = (table[name] for name in names)
            listed = (c.tolist() if isinstance(c, np.ndarray) else c for c in columns)
            writer.writerows(zip(*listed, strict=True))

        yield append


@contextmanager
def parquet_table(path: Path, names: tuple[str, ...]) -> Iterator[Append]:
    """A Parquet file with these columns; pyarrow is required."""
    import pyarrow as pa  # noqa: PLC0415  an optional dependency, slow to import
    from pyarrow import parquet  # noqa: PLC0415

    types = {**dict.fromkeys(_INTEGERS, pa.int32()), **dict.fromkeys(_TEXTS, pa.string())}
    schema = pa.schema([(name, types.get(name, pa.float64())) for name in names])
    waiting: list[Mapping[str, Column]] = []
    rows = 0

    def write() -> None:
        if waiting:
            arrays = [
                pa.array(_joined([table[name] for table in waiting]), schema.field(name).type)
                for name in names
            ]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            waiting.clear()

    def append(table: Mapping[str, Column]) -> None:
        nonlocal rows
        waiting.append(table)
        rows += len(table[names[0]])
        if rows >= _BATCH_ROWS:
            write()
            rows = 0

    # The high bytes of consecutive samples are alike: stored byte by byte they compress well.
    encoding = {
        "use_dictionary": [name for name in names if name in types],
        "use_byte_stream_split": [name for name in names if name not in types],
    }
    with (
        whole_file(path) as temporary,
        parquet.ParquetWriter(temporary, schema, compression="zstd", **encoding) as writer,
    ):
        yield append
        write()


def _joined(parts: list[Column]) -> Column:
    """Columns one after the other, as an array if all of them are."""
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts)
    return list(itertools.chain.from_iterable(parts))
