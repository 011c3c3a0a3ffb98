"""Period of a setpoint, and stretches in which it is constant."""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS


class Periods(NamedTuple):
    """A periodic stretch of a setpoint.

    Attributes:
        first: Index of its first sample.
        periods: Whole periods.
    """

    first: int
    samples: int
    periods: int

    def fold(self, column: FloatArray) -> FloatArray:
        """A column period by period, shape (periods, samples in a period).

        The first period, in which the plant settles, is left out where two others remain.
        """
        skipped = 1 if self.periods > 2 else 0
        first = self.first + skipped * self.samples
        last = self.first + self.periods * self.samples
        return column[first:last].reshape(-1, self.samples)


def periods_of(setpoint: FloatArray) -> Periods | None:
    """The longest stretch that repeats with the shortest period, or None.

    Only periods of a whole number of samples are found, twice over at least.
    """
    spread = float(setpoint.std())
    if not spread > 0.0:
        return None
    same = CONSTANTS.numerics * float(np.ptp(setpoint))
    for lag in sorted(_likely_lags(setpoint - setpoint.mean())):
        equal = np.abs(setpoint[lag:] - setpoint[:-lag]) <= same
        longest = max(runs(equal), key=lambda run: run.stop - run.start, default=slice(0, 0))
        first, length = longest.start, longest.stop - longest.start
        whole = setpoint[first : first + lag]
        # A hold has any period.
        if length >= lag and whole.std() >= 0.5 * spread:
            return Periods(first, lag, 1 + length // lag)
    return None


def holds(setpoint: FloatArray, fewest: float) -> list[slice]:
    """Stretches of constant setpoint, `fewest` samples or longer."""
    same = CONSTANTS.numerics * max(float(np.ptp(setpoint)), float(np.abs(setpoint).max()))
    moves = np.flatnonzero(np.abs(np.diff(setpoint)) > same) + 1
    ends = np.concatenate([[0], moves, [setpoint.size]])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends) if b - a >= fewest]


def _likely_lags(x: FloatArray) -> list[int]:
    """The lags, 8 or more, of the 40 highest peaks of the autocorrelation."""
    from scipy.signal import correlate  # noqa: PLC0415  slow to import

    n = x.size
    likeness = correlate(x, x, method="fft")[n - 1 :] / np.arange(n, 0, -1)
    lags = np.arange(8, n // 2 + 1)
    peak = likeness[lags] >= np.maximum(likeness[lags - 1], likeness[lags + 1])
    peaks = lags[peak]
    return [int(lag) for lag in peaks[np.argsort(-likeness[peaks])][:40]]


def runs(true: NDArray[np.bool_]) -> list[slice]:
    """The runs of true values."""
    edges = np.flatnonzero(np.diff(true.astype(np.int8), prepend=0, append=0)).tolist()
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
