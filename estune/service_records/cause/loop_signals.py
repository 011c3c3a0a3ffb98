"""Setpoint, measurement and output of a loop at its own pace, its swings, and its controller."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray

LONGEST = 1000
"""Samples that are compared; longer logs are thinned by means. The judge takes 0.1 s of CPU."""

SWING = 0.25
"""Least size of a swing of the output, over its range from the 2nd to the 98th percent."""


class JudgedSignals(NamedTuple):
    """Signals of a loop in automatic, shape (samples,) each.

    Attributes:
        interval_s: Time between two samples, s.
    """

    setpoint: FloatArray
    measurement: FloatArray
    output: FloatArray
    interval_s: float

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.measurement.size

    @property
    def error(self) -> FloatArray:
        """Setpoint less measurement."""
        return self.setpoint - self.measurement

    def thinned(self) -> "JudgedSignals":
        """At most `LONGEST` samples: means, and of the output its value at their end."""
        by = -(-self.samples // LONGEST)
        if by == 1:
            return self
        rows = self.samples // by * by
        setpoint, measurement = (
            x[:rows].reshape(-1, by).mean(axis=1) for x in (self.setpoint, self.measurement)
        )
        return JudgedSignals(
            setpoint, measurement, self.output[by - 1 : rows : by], by * self.interval_s
        )


def span(x: FloatArray) -> float:
    """Range between the 2nd and the 98th percent."""
    low, high = np.percentile(x, (2.0, 98.0))
    return float(high - low)


def swings(output: FloatArray) -> list[slice]:
    """Parts between the reversals of a signal that are larger than `SWING` of its range."""
    least, x = SWING * span(output), output.tolist()
    turns, high, low, rising = [0], 0, 0, None
    for k, value in enumerate(x):
        high = k if value > x[high] else high
        low = k if value < x[low] else low
        if rising is not False and value < x[high] - least:
            turns, rising, low = [*turns, high], False, k
        elif rising is not True and value > x[low] + least:
            turns, rising, high = [*turns, low], True, k
    turns.append(len(x) - 1)
    return [slice(a, b) for a, b in pairwise(turns) if b > a]


def swing_length(output: FloatArray) -> float:
    """Mean length of the swings in samples, by the time that they take."""
    lengths = [s.stop - s.start for s in swings(output)] or [output.size]
    return float(np.average(lengths, weights=lengths))


class Controller(NamedTuple):
    """The controller that the signals show.

    Attributes:
        P: Moves of the output over those of the measurement, with the sign of the loop's gain.
        I: Moves of the output over the error, per sample.
        D: The same of the second difference of the measurement.
        explained: Share of the moves' variance that it explains.
    """

    P: float
    I: float
    D: float
    explained: float

    @property
    def sign(self) -> float:
        """Sign of the plant's gain: feedback is negative."""
        by_size = self.P if abs(self.P) >= abs(self.I) else self.I
        return float(np.sign(by_size) or 1.0)


def shown_controller(signals: JudgedSignals) -> Controller:
    """The controller by least squares of the output's moves."""
    y, r, moves = signals.measurement, signals.setpoint, np.diff(signals.output)[1:]
    columns = np.column_stack(
        [-np.diff(y)[1:], signals.error[2:], -np.diff(y, 2), np.diff(r)[1:], np.ones(moves.size)]
    )
    scale = columns.std(axis=0) + np.abs(columns).max(axis=0) * 1e-9 + 1e-300
    found = np.linalg.lstsq(columns / scale, moves, rcond=1e-9)[0]
    left = moves - columns / scale @ found
    power = float(np.var(moves))
    explained = 1.0 - float(np.var(left)) / power if power else 0.0
    P, I, D = (found / scale)[:3].tolist()
    return Controller(P, I, D, explained)
