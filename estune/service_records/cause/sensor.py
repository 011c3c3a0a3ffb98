"""What a sensor does that no plant can: frozen readings, steps, spikes."""

from typing import Literal, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.loop_signals import JudgedSignals

SensorFault = Literal["frozen", "steps", "spikes", "noise"]

FROZEN = 25.0
"""Equal readings in a row from which the sensor is frozen: five times the next longest run."""

TURNS = 0.25
"""Share of moves that turn back, from which readings have noise: of white noise two thirds do, of
the swing of a loop sampled 20 times a tenth."""

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
    """Equal readings in a row while the output moves, many more than elsewhere.

    A reading may freeze several times, each at least half as long as the longest. An actuator that
    rests does the same to a measurement without noise: then one freeze alone is told.
    """
    y, u = signals.measurement, signals.output
    equal = np.concatenate([[False], np.diff(y) == 0.0, [False]])
    edges = np.flatnonzero(np.diff(equal.astype(np.int8)))
    lengths = np.sort([_moved(u[a : b + 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)])
    if not lengths.size or lengths[-1] < FROZEN:
        return None
    alike = lengths[2 * lengths >= lengths[-1]]
    others = lengths[2 * lengths < lengths[-1]]
    if lengths[-1] < 5 * others.max(initial=1) or (alike.size > 1 and not _is_noisy(y)):
        return None
    return SensorLaw("frozen", 0.0, int(lengths[-1]), float(alike.sum()) / y.size)


def _moved(output: FloatArray) -> int:
    """Samples of a part after the output's first move: a drive at rest stands for a reason."""
    moved = output != output[0]
    return int(moved.size - np.argmax(moved)) if moved.any() else 0


def _is_noisy(y: FloatArray) -> bool:
    """Whether readings that differ go up and down as noise does, and not as a motion."""
    moves = np.diff(y)
    moves = moves[moves != 0.0]
    return bool(np.mean(moves[1:] * moves[:-1] < 0.0) > TURNS) if moves.size > 2 else False


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
    """Single readings far from the two before and the two after, which agree.

    Neighbours of a spike, edges of a step, and turns of a fast swing are none: there these four
    disagree by half as much or more.
    """
    y = signals.measurement
    beside = np.array([y[:-4], y[1:-3], y[3:-1], y[4:]])
    apart = np.abs(y[2:-2] - np.median(beside, axis=0))
    # The 90th percent: a historian that repeats readings leaves a median of nothing.
    noise = float(np.percentile(apart, 90.0)) / 1.645
    hit = (apart > SPIKE * noise) & (np.ptp(beside, axis=0) < 0.5 * apart)
    if noise == 0.0 or hit.sum() < 3:  # one or two are chance among 80 logs of a plant
        return None
    return SensorLaw("spikes", float(np.median(apart[hit])), int(hit.sum()), float(hit.mean()))


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
