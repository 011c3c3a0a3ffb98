"""Where the search for a loop begins: fits of two poles to a part of the records."""

from collections.abc import Sequence
from typing import NamedTuple

from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.identification import START_NOISES, PoleFit, cold_starts
from estune.loop_model.records import LoopRecord
from estune.loop_model.whiteness import beyond_chance

STARTED_BY = 2
SAMPLES_STARTED_BY = 3000
SETTLING_TIMES_STARTED_BY = 25.0
"""Records, and samples of each, or settling times where they are longer, by which the starts of a
search are compared: seven settling times, of 400 samples each, began from the wrong one. They are
the first trials from rest, or else the longest records: the first two of 17 stretches of a
measured chamber, of 46 and 228 samples, led to a loop of another kind."""


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
        signals, starts = _starts(records, settling_time_s * sampling_Hz)
        power = starts[0].cost / signals.samples
        chance = beyond_chance(signals.samples) if best is other else 1.0
        if best is None or power < chance * best.power:
            best = Beginning(tuple(records), settling_time_s, tuple(starts), power)
    assert best is not None  # noqa: S101  a settling time is tried
    return best


def first_starts(records: Sequence[LoopRecord], settling: float) -> list[PoleFit]:
    """Fits of two poles, the best first, of a settling time asked for in samples."""
    return _starts(records, settling)[1]


def _starts(records: Sequence[LoopRecord], settling: float) -> tuple[FitSignals, list[PoleFit]]:
    samples = max(SAMPLES_STARTED_BY, round(SETTLING_TIMES_STARTED_BY * settling))
    # Trials from rest are whole; excitations of a loop, which are longer, begin no search.
    ranked = sorted(records, key=lambda r: (not r.at_rest, 0 if r.at_rest else -r.samples))
    few = [_shortened(record, samples) for record in ranked[:STARTED_BY]]
    signals = signals_of(few, settling)
    noises = START_NOISES[: 1 if all(r.at_rest for r in records) else None]
    return signals, cold_starts(signals, noises)


def _shortened(record: LoopRecord, samples: int) -> LoopRecord:
    part = slice(0, samples)
    return record._replace(
        effort=record.effort[part],
        measurement=record.measurement[part],
        setpoint=record.setpoint[part],
    )
