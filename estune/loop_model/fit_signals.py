"""Records as a fit takes them: deviations, those of equal length together."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.hum import hum_of
from estune.loop_model.records import LoopRecord


class RecordGroup(NamedTuple):
    """Records of equal length as deviations.

    Attributes:
        effort: Shape (records, samples).
        measurement: Shape (records, samples).
        history: Samples at the beginning that serve as the past of the others only.
        members: Their numbers among all records.
        rest: Samples before the first step of any; zero of records of service.
    """

    effort: FloatArray
    measurement: FloatArray
    history: int
    members: tuple[int, ...]
    rest: int

    @property
    def length(self) -> int:
        """Residuals of each record."""
        return int(self.effort.shape[1]) - self.history


class FitSignals(NamedTuple):
    """All records of a fit.

    Attributes:
        groups: Those of equal length together.
        settling_samples: Settling time asked for, in samples.
        resolution: Least standard deviation of the measurement that counts.
        hum: Frequency of a hum of the measurement, rad/sample; zero without one.
    """

    groups: tuple[RecordGroup, ...]
    settling_samples: float
    resolution: float
    hum: float = 0.0

    @property
    def samples(self) -> int:
        """Number of residuals."""
        return sum(len(g.members) * g.length for g in self.groups)

    @property
    def in_motion(self) -> bool:
        """Whether a record does not begin at rest, as those of service."""
        return any(group.history for group in self.groups)

    @property
    def longest(self) -> int:
        """Residuals of the longest record."""
        return max(g.length for g in self.groups)

    @property
    def records(self) -> int:
        """Number of records."""
        return sum(len(g.members) for g in self.groups)

    def rows(self) -> Iterator[tuple[int, slice]]:
        """The number of each record, and where its residuals stand among those of all."""
        at = 0
        for group in self.groups:
            for number in group.members:
                yield number, slice(at, at + group.length)
                at += group.length

    def split(self, errors: FloatArray) -> Iterator[FloatArray]:
        """Residuals of each group, shape (records, samples)."""
        at = 0
        for group in self.groups:
            shape = len(group.members), group.length
            yield errors[at : at + shape[0] * shape[1]].reshape(shape)
            at += shape[0] * shape[1]


REACH = 16
"""Samples beside the dead time that the filters of a residual reach back: six poles, the
forgetting of the load and a colour of eight."""

RESOLUTION = 1e-4
"""Share of the largest response below which residuals are not told from one another: the
resolution of a converter of 12 to 13 bits. Records simulated without noise would have poles added
until rounding errors are left."""


def signals_of(
    records: Sequence[LoopRecord], settling_samples: float, longest_dead: int | None = None
) -> FitSignals:
    """Records as deviations.

    A record at rest before its first sample has that rest as its past. Of others the first samples
    are the past: as many as the longest dead time, in a search the settling time, and the
    numerator reach back.
    """
    longest = round(settling_samples) if longest_dead is None else longest_dead
    by_kind: dict[tuple[int, bool], list[int]] = {}
    for number, record in enumerate(records):
        by_kind.setdefault((record.samples, record.at_rest), []).append(number)
    groups = []
    for (samples, at_rest), members in by_kind.items():
        chosen = [records[number] for number in members]
        history = 0 if at_rest else min(longest + REACH, samples // 2)
        effort = np.array([r.effort for r in chosen])
        measurement = np.array([r.measurement for r in chosen])
        before = [slice(0, max(r.step_index, 1) if at_rest else None) for r in chosen]
        effort -= np.array([[row[s].mean()] for row, s in zip(effort, before, strict=True)])
        measurement -= np.array(
            [[row[s].mean()] for row, s in zip(measurement, before, strict=True)]
        )
        rest = min(r.step_index for r in chosen) if at_rest else 0
        groups.append(RecordGroup(effort, measurement, history, tuple(members), rest))
    largest = max(float(np.abs(g.measurement).max(initial=0.0)) for g in groups)
    return FitSignals(tuple(groups), settling_samples, RESOLUTION * largest, hum_of(records))
