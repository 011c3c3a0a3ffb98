"""Which stretches of logs show a loop in service, and why the others do not."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.recordings.issue import DataIssue
from estune.service_records.sources import read_logs
from estune.service_records.stretches import Stretch, find_stretches

STILL = "the setpoint stands still: it shows load and noise, not the loop"


class JudgedStretch(NamedTuple):
    """A stretch of a log.

    Attributes:
        reason: Why it shows nothing of the loop; empty where it does.
    """

    log: str
    start_s: float
    stop_s: float
    reason: str


class JudgedLogs(NamedTuple):
    """Logs below a path: how they are understood, and which stretches show the loop.

    Attributes:
        stretches: In the order of the logs.
        columns: File, column, channel and unit.
        issues: Files that cannot be used, and what was done to time stamps.
    """

    stretches: list[JudgedStretch]
    columns: list[tuple[str, str, str, str]]
    issues: tuple[DataIssue, ...]


def judged_logs(path: Path, sources: Mapping[str, str] | None = None) -> JudgedLogs:
    """The logs of a loop below a path.

    Args:
        path: A file, a folder, or a run.
        sources: Channels of the columns that are not found by their names.

    Raises:
        InvalidInput: there is no log of setpoint and measurement.
    """
    read, found = read_logs(path, sources), list[JudgedStretch]()
    for log in read.logs:
        P = log.gains.P if log.gains is not None else None
        stretches, left_out = find_stretches(log, P)
        parts = [_judged(stretch, log.sampling_Hz) for stretch in stretches]
        parts += [JudgedStretch(*part) for part in left_out]
        found += sorted(parts, key=lambda part: part.start_s)
    columns = [
        (log.name, column, channel, log.units.get(column, ""))
        for log in read.logs
        for column, channel in log.sources.items()
    ]
    return JudgedLogs(found, columns, read.issues)


def _judged(stretch: Stretch, rate: float) -> JudgedStretch:
    stop_s = stretch.start_s + (stretch.samples - 1) / rate
    reason = "" if np.ptp(stretch.setpoint) > 0.0 else STILL
    return JudgedStretch(stretch.log, stretch.start_s, stop_s, reason)
