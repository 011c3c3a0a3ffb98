"""Which part of the data fits, which ranks and which reports.

What fits may not rank, and what ranks may not report. Whole records are kept from the fit where
others reach as far as they do, so that a model is judged on an excitation it has not seen; the
rest is dealt out in blocks of time, so that each part sees every regime.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.prediction.prediction import Index
from plants.diagnosis.result import DataSegment, Split

SPLITS: tuple[Split, ...] = ("fit", "rank", "report")
FIT, RANK, REPORT = range(3)

HELD_OUT = 0.25
"""Share of the data, by duration, that may be kept from the fit as whole records."""
WITHIN = 1.05
"""A record may be kept from the fit where its reach passes that of the others by no more than
this: a twentieth of what the records span."""
BLOCK_WINDOWS = 3
"""Least length of a block, in windows of the prediction."""
DEALT = (
    (FIT, FIT, RANK, FIT, FIT, REPORT) * 2,
    (FIT, FIT, RANK, FIT, FIT, REPORT),
    (FIT, RANK, FIT, REPORT),
    (FIT, RANK, REPORT),
)
"""How blocks of one record are dealt out, the finest first that leaves blocks long enough."""


@dataclass(frozen=True, slots=True, eq=False)
class DataSplit:
    """What each residual entry is used for.

    Attributes:
        entries: 0 fit, 1 rank, 2 report, shape (entries,).
        group: Number of the block it lies in, counted through all records, same shape.
        records: Numbers of the records kept from the fit.
        parts: The same in words, per record in order of time.
    """

    entries: NDArray[np.int64]
    group: NDArray[np.int64]
    records: frozenset[int]
    parts: tuple[DataSegment, ...]

    def where(self, *splits: int) -> NDArray[np.int64]:
        """Numbers of the entries of some splits."""
        return np.flatnonzero(np.isin(self.entries, splits))


def split_data(measurements: Sequence[MeasuredRecord], index: Index) -> DataSplit:
    """Splits the residuals' entries three ways.

    Args:
        measurements: The records.
        index: What the entries stand for.
    """
    kept = _kept_from_fit(measurements)
    entries = np.zeros(index.measurement.size, np.int64)
    group = np.zeros(index.measurement.size, np.int64)
    parts: list[DataSegment] = []
    blocks = 0
    for n, m in enumerate(measurements):
        mine = np.flatnonzero(index.measurement == n)
        if not mine.size:
            continue
        windows, place = np.unique(index.window[mine], return_inverse=True)
        uses = _uses(windows.size, kept.index(n) if n in kept else None, len(kept))
        block = place * len(uses) // windows.size
        entries[mine] = np.asarray(uses)[block]
        group[mine] = blocks + block
        blocks += len(uses)
        for b, use in enumerate(uses):
            times = index.time_s[mine[block == b]]
            if times.size:
                parts.append(
                    DataSegment(m.name, float(times.min()), float(times.max()), SPLITS[use])
                )
    return DataSplit(entries, group, frozenset(kept), tuple(parts))


def _uses(windows: int, kept: int | None, kept_records: int) -> tuple[int, ...]:
    """What the blocks of one record are used for."""
    if kept is not None:
        if kept_records > 1:
            blocks = max(1, min(6, windows // BLOCK_WINDOWS))
            return ((RANK, REPORT)[kept % 2],) * blocks
        blocks = max(2, min(8, windows // BLOCK_WINDOWS) // 2 * 2)
        return (RANK, REPORT) * (blocks // 2)
    for dealt in DEALT:
        if windows >= BLOCK_WINDOWS * len(dealt):
            return dealt
    return (FIT,)


def _kept_from_fit(measurements: Sequence[MeasuredRecord]) -> list[int]:
    """Numbers of the records kept whole from the fit, the shortest first."""
    reach = np.array([_reach(m) for m in measurements])
    slack = (WITHIN - 1.0) * np.ptp(reach, axis=0) if len(reach) else reach
    durations = np.array([m.duration_s for m in measurements])
    room = HELD_OUT * durations.sum()
    kept: list[int] = []
    for n in np.argsort(durations, kind="stable").tolist():
        others = [k for k in range(len(measurements)) if k != n and k not in kept]
        # A repeat would be judged on an excitation that was fitted.
        repeated = any(_same_excitation(measurements[n], measurements[k]) for k in others)
        if durations[n] > room or not others or repeated:
            continue
        if np.all(reach[n] <= reach[others].max(axis=0) + slack):
            kept.append(n)
            room -= durations[n]
    return kept


def _same_excitation(one: MeasuredRecord, other: MeasuredRecord) -> bool:
    """Whether two records were driven by the same signal."""
    mine, its = one.setpoint_N, other.setpoint_N
    if mine is None or its is None or mine.size != its.size:
        return False
    return bool(np.abs(mine - its).max() <= 1e-6 * max(float(np.abs(mine).max()), 1e-300))


def _reach(m: MeasuredRecord) -> FloatArray:
    """How far a record reaches: length, duration, and each channel's extent, level and rate."""
    length = m.cable_length_m or 0.0
    found = [length, -length, m.duration_s]
    for name in ("setpoint_N", "current_A", "tension_N", "angle_rad"):
        column = m.channel(name)
        if column is None or column.size < 2:
            found += [0.0] * 4
            continue
        rate = float(np.quantile(np.abs(np.diff(column)), 0.99)) * m.sampling_Hz
        # Where an encoder's zero lies is chance.
        levels = [0.0, 0.0] if name == "angle_rad" else [float(column.max()), -float(column.min())]
        found += [float(np.ptp(column)), *levels, rate]
    return np.array(found)
