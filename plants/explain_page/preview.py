"""Interpretation of recorded data, before anything is fitted to them."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import CHANNELS, MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion


class Preview(NamedTuple):
    """One record as it was understood.

    Attributes:
        name: Its name; a number follows where the file was split at gaps.
        sampling_Hz: Rate.
        cable_length_m: Or None.
        steps: Steps of the setpoint; None where it moves otherwise, or there is none.
        ranges: Least and greatest value of each column, SI units.
        signs: Correlation at low frequency by pair of columns: `tension_N by current_A` and so on.
    """

    name: str
    source: str
    samples: int
    sampling_Hz: float
    duration_s: float
    loop: str
    cable_length_m: float | None
    steps: int | None
    ranges: dict[str, tuple[float, float]]
    signs: dict[str, float]


def preview(m: MeasuredRecord) -> Preview:
    """Interpretation of a record."""
    columns = {name: c for name in CHANNELS if (c := m.channel(name)) is not None}
    return Preview(
        name=m.name,
        source=m.source,
        samples=m.samples,
        sampling_Hz=m.sampling_Hz,
        duration_s=m.duration_s,
        loop=m.loop,
        cable_length_m=m.cable_length_m,
        steps=_steps(m.setpoint_N),
        ranges={name: (float(c.min()), float(c.max())) for name, c in columns.items()},
        signs=_signs(m),
    )


def warnings(p: Preview) -> list[str]:
    """Signs that contradict the conventions: a positive current winds in, which pulls."""
    return [
        f"{pair.split(' by ')[0]} falls as {pair.split(' by ')[1]} rises (correlation "
        f"{value:.2f}); if nothing outside moves the cable, turn a sign, as in --scale "
        f"{pair.partition('_')[0]}=-1"
        for pair, value in p.signs.items()
        if value < -0.7
    ]


def _steps(setpoint: FloatArray | None) -> int | None:
    if setpoint is None:
        return None
    changes = int(np.count_nonzero(np.diff(setpoint)))
    return changes if changes <= 0.05 * setpoint.size else None


def _signs(m: MeasuredRecord) -> dict[str, float]:
    smoother = Smoother.slow(m.duration_s, m.sampling_Hz)
    effort = "current_A" if m.current_A is not None else "setpoint_N"
    correlations = {}
    for name, cause in (("tension_N", effort), ("tension_N", "angle_rad"), ("angle_rad", effort)):
        x, y = m.channel(name), m.channel(cause)
        if x is None or y is None:
            continue
        slope, share = proportion(smoother.sampled(y, 1.0), smoother.sampled(x, 1.0))
        if share > 0.0:
            correlations[f"{name} by {cause}"] = math.copysign(math.sqrt(share), slope)
    return correlations
