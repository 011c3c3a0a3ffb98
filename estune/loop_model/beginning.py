"""Where the search for a loop begins: fits of two poles to a part of the records."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.identification import (
    ROUGH,
    START_NOISES,
    PoleFit,
    by_cost,
    cold_starts,
    improve,
)
from estune.loop_model.records import LoopRecord
from estune.loop_model.whiteness import beyond_chance

STARTED_BY = 2
SAMPLES_STARTED_BY = 3000
SETTLING_TIMES_STARTED_BY = 25.0
"""Records, and samples of each, or settling times where they are longer, by which the starts of a
search are compared: seven settling times, of 400 samples each, began from the wrong one. They are
the first trials from rest, or else the longest records: the first two of 17 stretches of a
measured chamber, of 46 and 228 samples, led to a loop of another kind."""

THIN_FROM, THIN = 1 << 18, 2000
"""Samples by which starts are sought, from which the records are thinned, to as many samples in a
settling time: of two million at 90 000 in a settling time the search took three minutes."""

HOPELESS = 2.0
"""Ratio of the mean square errors of a thinned start and of the best so far, from which the start
is not improved on all samples."""


class Beginning(NamedTuple):
    """Where the search for a loop begins.

    Attributes:
        starts: Fits of two poles, the best first.
        power: Mean square of the prediction errors of the best.
    """

    records: tuple[LoopRecord, ...]
    settling_time_s: float
    starts: tuple[PoleFit, ...]
    power: float


def best_scale(
    records: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_times_s: Sequence[float],
    other: Beginning | None = None,
) -> Beginning:
    """The beginning of a search with the least error.

    Args:
        records: At least one.
        sampling_Hz: Sampling rate.
        settling_times_s: Those that are tried, at least one.
        other: One with the same signals in another form, which is left only where the errors of
            these are no larger than chance allows.
    """
    best = other
    for settling_time_s in settling_times_s:
        least = math.inf if best is None else best.power
        signals, starts = _starts(records, settling_time_s * sampling_Hz, least)
        power = starts[0].cost / signals.samples
        chance = beyond_chance(signals.samples) if best is other else 1.0
        if best is None or power < chance * best.power:
            best = Beginning(tuple(records), settling_time_s, tuple(starts), power)
    assert best is not None  # noqa: S101  a settling time is tried
    return best


def first_starts(records: Sequence[LoopRecord], settling: float) -> list[PoleFit]:
    """Fits of two poles, the best first, of a settling time asked for in samples."""
    return _starts(records, settling)[1]


def _starts(
    records: Sequence[LoopRecord], settling: float, least: float = math.inf
) -> tuple[FitSignals, list[PoleFit]]:
    """Signals and starts of a settling time in samples, the best first.

    Args:
        least: Mean square error of the best start so far.
    """
    samples = max(SAMPLES_STARTED_BY, round(SETTLING_TIMES_STARTED_BY * settling))
    # Trials from rest are whole; excitations of a loop, which are longer, begin no search.
    ranked = sorted(records, key=lambda r: (not r.at_rest, 0 if r.at_rest else -r.samples))
    few = [_shortened(record, samples) for record in ranked[:STARTED_BY]]
    signals = signals_of(few, settling)
    noises = START_NOISES[: 1 if all(r.at_rest for r in records) else None]
    by = int(settling / THIN)
    if sum(record.samples for record in few) <= THIN_FROM or by < 2:
        return signals, cold_starts(signals, noises)
    thin = signals_of([_thinned(record, by) for record in few], settling / by)
    starts = [_of_all(signals, one, by) for one in cold_starts(thin, noises)]
    first = min(starts, key=by_cost)
    if first.cost < HOPELESS * least * signals.samples:
        starts = [improve(signals, first, ROUGH), *(one for one in starts if one is not first)]
    return signals, sorted(starts, key=by_cost)


def _thinned(record: LoopRecord, by: int) -> LoopRecord:
    """A record at a rate so many times lower, its effort the mean of what was held."""
    count = record.samples // by

    def at(signal: FloatArray) -> FloatArray:
        return np.array(signal[: count * by : by])

    effort = record.effort[: count * by].reshape(count, by).mean(axis=1)
    return record._replace(
        effort=effort, measurement=at(record.measurement), setpoint=at(record.setpoint)
    )


def _of_all(signals: FitSignals, thin: PoleFit, by: int) -> PoleFit:
    """A fit of two poles to a record at a lower rate, as one of all samples."""
    coordinates = thin.coordinates - [math.log(by), 0.0]
    return PoleFit.at(signals, coordinates, thin.dead * by, thin.noise)


def _shortened(record: LoopRecord, samples: int) -> LoopRecord:
    part = slice(0, samples)
    return record._replace(
        effort=record.effort[part],
        measurement=record.measurement[part],
        setpoint=record.setpoint[part],
    )
