"""Black box of a rig as a file: the last minutes of its motion, written round and round.

A block of `HEAD_BYTES` begins it: `MAGIC`, and the metadata of a record as JSON, filled up by
spaces. Rows of `ROW` follow; the oldest is overwritten by the newest, and a row that was never
written is zero. A program that is killed in a write spoils one row at most.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.recordings.issue import Unusable
from estune.support.file_limits import parse_json
from estune.trial.records import COLUMNS

ENDING = ".blackbox"
MAGIC = b"ESTBOX01"
HEAD_BYTES = 4096

ROW = np.dtype(
    [("sample", "<u8"), *((name, "<f8") for name in COLUMNS), ("phase", "u1"), ("flags", "u1")]
)
"""One sample: its number since the loop began, from 1, time by the loop's own clock, the other
columns of a record, `MotionPhase` of `estune.hardware.shared_memory`, flags as in a record."""


class BlackBoxFile(NamedTuple):
    """Contents of a black box: metadata, and its rows of `ROW`, oldest first."""

    metadata: dict[str, Any]
    rows: NDArray[np.void]


def head(metadata: dict[str, Any]) -> bytes:
    """The block that begins the file."""
    return (MAGIC + json.dumps(metadata).encode()).ljust(HEAD_BYTES)


def read_file(path: Path) -> BlackBoxFile:
    """Reads a black box, also while its rig writes it.

    Raises:
        Unusable: it is none, or damaged.
    """
    data = path.read_bytes()
    if not data.startswith(MAGIC) or len(data) < HEAD_BYTES:
        raise Unusable("the file is no black box, or cut off; copy it again")
    metadata = parse_json(data[len(MAGIC) : HEAD_BYTES])
    body = data[HEAD_BYTES:]
    rows = np.frombuffer(body, ROW, len(body) // ROW.itemsize)
    rows = rows[rows["sample"] > 0]
    return BlackBoxFile(metadata, rows[np.argsort(rows["sample"], kind="stable")])
