"""What a sensor does that no plant can: frozen readings, steps, spikes."""

from typing import Literal, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.loop_signals import JudgedSignals

SensorFault = Literal["frozen", "steps", "spikes", "noise"]

FROZEN = 25.0
"""Equal readings in a row from which the sensor is frozen: five times the next longest run."""

LEVELS = 12.0
"""Range of the measurement in steps up to which the steps are what the controller reacts to."""

SPIKE = 8.0
"""Height of a spike in deviations of the noise; readings beside it agree to half of it."""


HIDES = 0.25
"""Deviation of the noise over the setpoint's range, from which it hides the setpoint's moves. The
noisiest of 25 logs of a plant has 0.12."""

OTHERS = 0.5
"""Least variance of that noise over what is left of the measurement's: a loop that swings about a
setpoint which hardly moves has less. Of 18 simulated sensors whose noise hides the setpoint all
have that, 13 have as much as the rest; of 175 other loops none is above `HIDES`."""


class SensorLaw(NamedTuple):
    """A fault of the sensor.

    Attributes:
        fault: What it does.
        size: Size of the steps or spikes, or the noise's deviation, in the measurement's unit.
        number: Number of spikes, levels, or frozen readings.
        share: Share of the log it makes up.
    """

    fault: SensorFault
    size: float
    number: int
    share: float


def frozen(signals: JudgedSignals) -> SensorLaw | None:
    """The longest run of equal readings while the output moves, if no other is nearly as long."""
    y, u = signals.measurement, signals.output
    equal = np.concatenate([[False], np.diff(y) == 0.0, [False]])
    edges = np.flatnonzero(np.diff(equal.astype(np.int8)))
    runs = [(int(b - a), int(a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    moved = sorted(
        (length for length, at in runs if np.ptp(u[at : at + length + 1]) > 0.0), reverse=True
    )
    if not moved:
        return None
    others = moved[1] if len(moved) > 1 else 1
    if moved[0] < FROZEN or moved[0] < 5 * others:
        return None
    return SensorLaw("frozen", 0.0, moved[0], moved[0] / y.size)


def steps(signals: JudgedSignals) -> SensorLaw | None:
    """A step of the readings so large that the measurement has few levels."""
    y = signals.measurement
    jumps = np.abs(np.diff(y))
    size = float(jumps[jumps > 1e-9 * np.ptp(y)].min(initial=np.inf))
    if not np.isfinite(size):
        return None
    off = np.abs(jumps / size - np.round(jumps / size))
    levels = float(np.subtract(*np.percentile(y, (98.0, 2.0)))) / size
    if levels > LEVELS or np.mean(off < 0.02) < 0.98:
        return None
    return SensorLaw("steps", size, round(levels) + 1, 1.0)


def spikes(signals: JudgedSignals) -> SensorLaw | None:
    """Single readings far from both neighbours, which agree with those beside them."""
    y = signals.measurement
    # A cubic through four neighbours: a line through two takes a fast swing for spikes.
    cubic = (4.0 * (y[1:-3] + y[3:-1]) - (y[:-4] + y[4:])) / 6.0
    apart, beside = y[2:-2] - cubic, np.abs(y[3:-1] - y[1:-3])
    # The 90th percent: a historian that repeats readings leaves a median of nothing.
    noise = float(np.percentile(np.abs(apart), 90.0)) / 1.645
    hit = (np.abs(apart) > SPIKE * noise) & (beside < 0.5 * np.abs(apart))
    if noise == 0.0 or hit.sum() < 3:  # one or two are chance among 80 logs of a plant
        return None
    return SensorLaw(
        "spikes", float(np.median(np.abs(apart[hit]))), int(hit.sum()), float(hit.mean())
    )


def noise(signals: JudgedSignals) -> SensorLaw | None:
    """White noise so large that the loop cannot see its setpoint move."""
    moved = float(np.ptp(signals.setpoint))
    deviation = noise_deviation(signals.measurement)
    others = max(float(np.var(signals.measurement)) - deviation**2, 0.0)
    if moved == 0.0 or deviation < HIDES * moved or deviation**2 < OTHERS * others:
        return None
    return SensorLaw("noise", deviation, signals.samples, 1.0)


def noise_deviation(y: FloatArray) -> float:
    """Standard deviation of the white part of a signal, by its second differences."""
    return float(_deviation(np.diff(y, 2)) / np.sqrt(6.0))


def _deviation(x: FloatArray) -> float:
    return float(np.median(np.abs(x)) / 0.6745)
