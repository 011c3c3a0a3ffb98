"""The force of an outside sensor whose readings another program writes to a file."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from estune.errors import InvalidInput
from estune.recordings.raw_file import read_raw
from plants.bench.felt_force.force_procedure import ForceRecord

TIME, FORCE = "time_s", "force_N"


def with_outside_force(record: ForceRecord, path: Path, clock_s: float) -> ForceRecord:
    """A record with the force of a file in place of the felt force.

    Args:
        path: File with the columns `time_s`, Unix time, and `force_N`.
        clock_s: Unix time at which the clock of the record was zero.

    Raises:
        InvalidInput: a column is missing, or the file does not cover the test.
    """
    columns = {c.name: np.asarray(c.values, np.float64) for c in read_raw(path).channels}
    if not {TIME, FORCE} <= set(columns):
        raise InvalidInput(
            f"{path} has the columns {', '.join(columns)}; it needs {TIME} (Unix time) and {FORCE}"
        )
    stamps_s, wanted_s = columns[TIME], record.time_s + clock_s
    if not (stamps_s[0] <= wanted_s[0] and wanted_s[-1] <= stamps_s[-1]):
        raise InvalidInput(
            f"{path} lasts from {stamps_s[0]:.1f} to {stamps_s[-1]:.1f} s, the test from "
            f"{wanted_s[0]:.1f} to {wanted_s[-1]:.1f} s; record the sensor during the whole test, "
            "in Unix time"
        )
    return replace(record, felt_N=np.interp(wanted_s, stamps_s, columns[FORCE]))
