"""Records of machines measured by other people; the data are not part of this project."""

import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from plants.diagnosis.data.measured_record import MeasuredRecord

COLUMNS = ("setpoint_N", "current_A", "tension_N", "angle_rad", "reference_N", "flags")


def folder(named: Path | None) -> Path:
    """Folder of third-party data: as given, by ESTUNE_DATA, or `data` here or one above."""
    places = (Path("data"), Path("..", "data"))
    found = next((place for place in places if place.is_dir()), places[0])
    return named or Path(os.environ.get("ESTUNE_DATA", found))


def cut(record: MeasuredRecord, pieces: int) -> Iterator[MeasuredRecord]:
    """A record as so many files, each from its own time zero."""
    edges = np.linspace(0, record.samples, pieces + 1).astype(int)
    for a, b in pairwise(edges.tolist()):
        parts = {name: getattr(record, name) for name in COLUMNS}
        kept = {name: part[a:b] for name, part in parts.items() if part is not None}
        time_s = record.time_s[: b - a]
        yield replace(record, name=f"{record.name}.{a}", time_s=time_s, **kept)
