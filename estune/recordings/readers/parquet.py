"""Parquet, with a record's metadata under the key `estune` of the file's own."""

from pathlib import Path

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.support.file_limits import parse_json

KEY = b"estune"


def read_parquet(path: Path) -> RawFile:
    """Reads all columns."""
    import pyarrow as pa  # noqa: PLC0415  an optional dependency, slow to import
    from pyarrow import parquet  # noqa: PLC0415

    try:
        with parquet.ParquetFile(path) as file:
            frame = file.read().to_pandas()
            own = file.schema_arrow.metadata or {}
    except (pa.ArrowException, OSError) as error:
        raise Unusable("the file is truncated or no Parquet; copy or export it again") from error
    metadata = parse_json(own[KEY]) if KEY in own else {}
    return RawFile(
        tuple(Channel(str(name), frame[name].to_numpy()) for name in frame.columns), metadata
    )
