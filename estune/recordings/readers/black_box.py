"""The black box of a rig, and its copies after a stop."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estune.recordings.black_box_file import read_file
from estune.recordings.issue import Unusable
from estune.recordings.metadata import metadata_beside
from estune.recordings.raw_file import Channel, RawFile
from estune.trial.records import COLUMNS

HELD_samples = 5
"""Sampling instants that the loop skipped and that are filled by the reading before; more is a
gap, where the record is split."""


def read_black_box(path: Path) -> RawFile:
    """Reads all columns of a record, on the grid of the loop's instants."""
    metadata, rows = read_file(path)
    still = np.diff(rows["time_s"]) <= 0.0
    if still.any():
        row = int(still.argmax()) + 2
        raise Unusable("repeats the time of the row before; copy the file again", "time_s", row)
    instants = sampling_instants(rows["time_s"], metadata["sampling_Hz"])
    repeats = np.diff(instants, append=instants[-1:] + 1)
    repeats[repeats > HELD_samples] = 1
    first = np.cumsum(repeats) - repeats
    held = np.arange(repeats.sum()) - np.repeat(first, repeats)
    time_s = (np.repeat(instants, repeats) + held) / metadata["sampling_Hz"]
    names = [n for n in (*COLUMNS[1:], "flags") if rows[n].any()]  # without a sensor it is zero
    columns = {"time_s": time_s} | {n: np.repeat(rows[n], repeats) for n in names}
    channels = tuple(Channel(name, values) for name, values in columns.items())
    return RawFile(channels, metadata | metadata_beside(path))


def sampling_instants(time_s: NDArray[np.float64], rate_Hz: float) -> NDArray[np.int64]:
    """The instant of each sample on the loop's grid, from 0; one that was skipped is missing.

    A sample is read at its instant or late, never early, and the loop skips instants and never
    makes up for them: the offset of the grid to the count only grows, and is the least that any
    later sample shows.
    """
    count = np.arange(time_s.size)
    offset = (time_s - time_s[:1]) * rate_Hz - count
    least = np.minimum.accumulate(offset[::-1])[::-1]
    instants: NDArray[np.int64] = count + np.rint(least - least[:1]).astype(np.int64)
    return instants
