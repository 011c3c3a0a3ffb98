"""Noise of a signal without its lines and drift, and its rounding step."""

import math

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS


def spectral_rms(deviation: FloatArray) -> float:
    """Rms of noise, shape (samples,), without drift, single lines and short bursts.

    The median over overlapping segments of the periodogram (so that bursts do not count) is
    freed of lines and summed over frequency (Welch 1967; bias of the median as in SciPy).
    """
    from scipy.ndimage import median_filter  # noqa: PLC0415  slow to import

    power, line = _spectrum(deviation, average="median")
    width = min(2 * max(4, power.size // 20) + 1, 2 * ((power.size - 1) // 2) + 1)
    neighbours = median_filter(power, width, mode="mirror")
    quiet = np.where(power > CONSTANTS.clear**2 * neighbours, neighbours, power)
    return float(np.sqrt(quiet.sum() * line))


def upper_rms(signal: FloatArray) -> float:
    """Rms of white noise on a moving signal, from the upper half of its spectrum.

    The lower quartile of the lines there is taken, corrected by what the quartile of a
    chi-squared spectrum is below its mean.
    """
    from scipy.special import gammaincinv  # noqa: PLC0415  slow to import

    # A second difference keeps the leakage of slow, large motion below the noise.
    power, width = _spectrum(np.diff(signal, 2), average="mean")
    frequency = np.arange(1, power.size + 1) * width
    white = power / (2.0 * np.sin(np.pi * frequency)) ** 4
    upper = white[white.size // 2 :]  # the plant's motion is negligible there
    quarter = 0.25  # modes and lines may exceed it
    segments = max(1.0, 2.0 * signal.size / _segment(signal.size) - 1.0)
    freedom = 2.0 * segments * 0.9  # half overlapping Hann segments: 0.9 of independent ones
    share = 2.0 * float(gammaincinv(0.5 * freedom, quarter)) / freedom  # of chi-squared
    return float(np.sqrt(0.5 * np.quantile(upper, quarter) / share))


def step_of(signal: FloatArray) -> float:
    """The step that readings are whole multiples of, or 0 where there is none.

    Of two values, as of a drum that moves by one count, it is their distance at the most. Counts
    that were written in degrees with a few decimals are multiples only to within these.
    """
    distinct = np.unique(signal)
    gaps = np.diff(distinct)
    gaps = np.sort(gaps[gaps > 1e-9 * np.abs(distinct).max()])
    if gaps.size < 2:
        return float(gaps.sum())
    for divisor in (1.0, 2.0, 3.0):  # no two readings may be adjacent
        step, counts = gaps[0] / divisor, np.ones(gaps.size)
        # Small gaps tell the step well enough for those of twice as many counts.
        for most in 1.5 * 2.0 ** np.arange(math.ceil(math.log2(gaps[-1] / gaps[0])) + 1):
            small = gaps[gaps <= most * gaps[0]]
            counts = np.rint(small / step)
            step = small.sum() / counts.sum()
        if np.abs(gaps / step - counts).max() < CONSTANTS.written:
            return float(step)
    return 0.0


def _segment(samples: int) -> int:
    return int(min(samples, 1024, max(CONSTANTS.fewest // 2, samples // 8)))


def _spectrum(signal: FloatArray, average: str) -> tuple[FloatArray, float]:
    """One-sided power per line and the lines' distance, cycles per sample, without the mean.

    Welch's segments all at once: `scipy.signal.welch` takes the trend out of each by itself.
    """
    from scipy.signal import periodogram  # noqa: PLC0415  slow to import

    segment = _segment(signal.size)
    cut = np.lib.stride_tricks.sliding_window_view(signal, segment)[:: segment - segment // 2]
    _, powers = periodogram(cut, window="hann", detrend="linear")
    power = powers.mean(axis=0)
    if average == "median":
        power = np.median(powers, axis=0) / _median_bias(len(cut))
    power[:2] = power[2]  # removed with the trend
    return power[1:], 1.0 / segment


def _median_bias(number: int) -> float:
    """Median of so many periodograms of noise over their mean (Allen et al. 2012, appendix B)."""
    even = 2.0 * np.arange(1.0, (number - 1) // 2 + 1)
    return float(1.0 + np.sum(1.0 / (even + 1.0) - 1.0 / even))
