"""Setpoint, measurement and output of a loop at its own pace, its swings, and its controller."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray

LONGEST = 1000
"""Samples that are compared; longer logs are thinned by means. The judge takes 0.1 s of CPU."""

EXPLAINED = 0.99
"""Share of the output's variance from which a controller explains it. The moves of a chamber's
output, which is a whole number, give half of P and an integral that does not run, and Ms 3.8 or
none for 1.3 to 1.6; the output itself, of which 0.999 is explained, gives P to 1 %."""

LOST = 0.02
"""Share of the error's motion that means may lose: a wave keeps 13 samples a period. A servo that
settles in 30 ms, in a log of 16 s, was thinned to 16 ms, and its answers to steps became a wave
from outside."""

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
        """At most `LONGEST` samples: means, and of the output its value at their end.

        The means keep the motion of the error. Where the whole log is too long for that, the part
        whose error moves most like that of the whole is taken.
        """
        by = -(-self.samples // LONGEST)
        while by > 1 and self._lost(by) > LOST:
            by = -(-by // 2)
        rows = self.samples // by * by
        setpoint, measurement = (
            x[:rows].reshape(-1, by).mean(axis=1) for x in (self.setpoint, self.measurement)
        )
        interval_s = by * self.interval_s
        means = JudgedSignals(setpoint, measurement, self.output[by - 1 : rows : by], interval_s)
        if means.samples <= LONGEST:
            return means
        starts = np.linspace(0, means.samples - LONGEST, -(-means.samples // LONGEST)).astype(int)
        parts = [slice(int(start), int(start) + LONGEST) for start in starts]
        spread = [float(np.std(means.error[part])) for part in parts]
        at = int(np.argmin(np.abs(np.array(spread) - float(np.std(means.error)))))
        return means.part(parts[at])

    def part(self, rows: slice) -> "JudgedSignals":
        """Some rows."""
        return self._replace(
            setpoint=self.setpoint[rows],
            measurement=self.measurement[rows],
            output=self.output[rows],
        )

    def _lost(self, by: int) -> float:
        """Share of the variance of the error, less its white part, that means over rows lose."""
        rows = self.samples // by * by
        means = self.error[:rows].reshape(-1, by).mean(axis=1)
        white = float(np.median(np.diff(self.error, 2) ** 2)) / 6.0 / 0.455
        whole = float(np.var(self.error)) - white
        return 1.0 - (float(np.var(means)) - white / by) / whole if whole > white else 0.0


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
        explained: Share of the variance of the output, or its moves, that it explains.
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
    """The controller by least squares of the output's moves, or of the output where that shows it.

    Rounding is small beside the output and as large as its moves. Nobody but the controller moves
    an output that it explains; another is moved by hand, held, or fed forward, at times.
    """
    y, r, u = signals.measurement, signals.setpoint, signals.output
    whole = _least_squares(
        np.column_stack([-y, np.cumsum(signals.error), -np.diff(y, prepend=y[0]), r]), u
    )
    moves = _least_squares(
        np.column_stack([-np.diff(y)[1:], signals.error[2:], -np.diff(y, 2), np.diff(r)[1:]]),
        np.diff(u)[1:],
    )
    return whole if whole.explained > max(EXPLAINED, moves.explained) else moves


def _least_squares(columns: FloatArray, wanted: FloatArray) -> Controller:
    """The controller whose P and I have one sign: collinear columns gave a P below zero."""
    from scipy.optimize import lsq_linear  # noqa: PLC0415  slow to import

    scale = columns.std(axis=0) + np.abs(columns).max(axis=0) * 1e-9 + 1e-300
    design, power = (columns - columns.mean(axis=0)) / scale, float(np.var(wanted))
    if not power:
        return Controller(0.0, 0.0, 0.0, 0.0)
    free, wanted = np.full(2, np.inf), (wanted - wanted.mean()) / math.sqrt(power)
    found = [
        lsq_linear(design, wanted, bounds=bounds)
        for bounds in (
            (np.concatenate([np.zeros(2), -free]), np.inf),
            (-np.inf, np.concatenate([np.zeros(2), free])),
        )
    ]
    best = min(found, key=lambda one: float(one.cost))
    P, I, D = (best.x[:3] / scale[:3] * math.sqrt(power)).tolist()
    return Controller(P, I, D, 1.0 - 2.0 * float(best.cost) / wanted.size)
