"""Spectra of the periods of an excitation and of its response."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.excitation import BroadbandExcitation, Segment

ComplexArray = NDArray[np.complex128]

SMOOTHED_LINES = 11
"""Lines over which the noise level is averaged."""
UNSETTLED_P_VALUE = 1e-6
"""Significance level at which a record is rejected as not settled."""
NEGLIGIBLE = 1e-4
"""Allowed deviation of the first period as a share of the output."""


class SegmentSpectra(NamedTuple):
    """Spectra of the periods of one segment, scaled so that a sine of 1 N has amplitude 1 N."""

    segment: Segment
    excited: NDArray[np.int64]
    U: ComplexArray
    Y: ComplexArray
    variance: FloatArray  # mean square of one period's error on the excited lines
    coherence: FloatArray
    spectra: ComplexArray  # output of each period, all lines, shape (periods, lines)

    @property
    def periods(self) -> int:
        """Periods evaluated."""
        return len(self.spectra)

    @classmethod
    def of(cls, segment: Segment, u: FloatArray, y: FloatArray) -> "SegmentSpectra":
        """Spectra of a segment's input and output."""
        samples = segment.period_N.size
        start = segment.settling_periods * samples
        inputs, outputs = (
            2.0 / samples * np.fft.rfft(signal[start:].reshape(-1, samples), axis=1)
            for signal in (u, y)
        )
        lines = segment.excited
        U, Y = inputs[:, lines], outputs[:, lines]
        U_mean, Y_mean = U.mean(axis=0), Y.mean(axis=0)
        # The error of Y - G U includes the noise of a measured input.
        error = Y - Y_mean - Y_mean / U_mean * (U - U_mean)
        power = _power(U) * _power(Y)
        together = np.abs((Y * U.conj()).mean(axis=0)) ** 2
        coherence = np.divide(together, power, out=np.zeros_like(power), where=power > 0.0)
        variance = np.sum(np.abs(error) ** 2, axis=0) / (segment.periods - 1)
        return cls(segment, lines, U_mean, Y_mean, variance, coherence, outputs)


def _power(spectra: ComplexArray) -> FloatArray:
    return np.asarray(np.mean(np.abs(spectra) ** 2, axis=0))


def running_mean(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Running mean over neighbouring lines, and the number of lines."""
    width = min(SMOOTHED_LINES, values.size)
    window = np.ones(width)
    lines = np.convolve(np.ones(values.size), window, "same")
    return np.convolve(values, window, "same") / lines, lines


def check_settled(excitation: BroadbandExcitation, parts: list[SegmentSpectra]) -> None:
    """Checks that the first period differs from the others no more than by noise."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    periods = parts[0].periods
    if periods < 3:
        return
    spectra = np.concatenate([part.spectra[:, part.excited] for part in parts], axis=1)
    rest = spectra[1:].mean(axis=0)
    among = float(np.sum(np.abs(spectra[1:] - rest) ** 2)) / (periods - 2)
    first = float(np.sum(np.abs(spectra[0] - rest) ** 2)) * (periods - 1) / periods
    n = spectra.shape[1]
    size = float(np.sum(np.abs(rest) ** 2))
    if first <= NEGLIGIBLE**2 * size:  # without noise, any difference is significant
        return
    if among == 0.0 or fdtrc(2 * n, 2 * n * (periods - 2), first / among) < UNSETTLED_P_VALUE:
        share = 100.0 * math.sqrt((first - among) / size)
        raise InvalidInput(
            f"the first evaluated period differs from the later ones by {share:.2g} % of the "
            f"output: not settled after {excitation.segments[0].settling_periods} periods; give "
            "more settling periods"
        )
