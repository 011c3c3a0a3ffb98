"""Excitation signals for a frequency response: multisine, chirp and stepped sine.

All are periodic with a whole number of samples per period: the Fourier transform of a period has
no leakage, and differences between periods are noise. Lines are multiples of the frequency of the
period. Unexcited even lines show even distortion (a square law, slack), unexcited odd lines odd
distortion (a cubic law, friction, saturation) (Pintelon & Schoukens, System Identification, 2nd
ed., chapter 4).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray, check_positive
from estune.errors import InvalidInput

Lines = NDArray[np.int64]

PERIODS_MIN = 2
"""Periods for an estimate of the noise; four or more are better."""
CREST_ROUNDS = 300
CLIP = 0.9
"""Clipping level of the crest-factor iteration, relative to the peak."""
ODD_GROUP = 4
"""One odd line out of this many is left unexcited, to show odd distortion."""


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A part of an excitation in which one period repeats."""

    period_N: FloatArray  # one period of the signal, shape (period samples,), N
    settling_periods: int  # periods before the evaluation, in which the plant settles
    periods: int  # periods evaluated
    excited: Lines  # lines that carry the signal
    even: Lines  # unexcited lines that show even distortion
    odd: Lines  # unexcited lines that show odd distortion

    @property
    def samples(self) -> int:
        """Number of samples, settling included."""
        return self.period_N.size * (self.settling_periods + self.periods)


@dataclass(frozen=True, eq=False)
class BroadbandExcitation:
    """A signal to be added to the preload, with its excited and unexcited lines.

    Made by `multisine`, `chirp` and `stepped_sine`.
    """

    # Its kind, as a trial record names it; a stepped sine is `custom`.
    profile: Literal["multisine", "chirp", "custom"]
    sampling_Hz: float  # sampling rate
    # One for multisine and chirp, one per frequency for the stepped sine.
    segments: tuple[Segment, ...]

    @cached_property
    def waveform_N(self) -> FloatArray:
        """The signal without the preload, shape (samples,), N."""
        repeats = [(s.period_N, s.settling_periods + s.periods) for s in self.segments]
        return np.concatenate([np.tile(period, count) for period, count in repeats])

    @property
    def duration_s(self) -> float:
        """Duration of the signal, s."""
        return sum(segment.samples for segment in self.segments) / self.sampling_Hz

    @property
    def crest_factor(self) -> float:
        """Peak over root mean square."""
        return float(np.abs(self.waveform_N).max() / self.waveform_N.std())


@dataclass(frozen=True, slots=True)
class Band:
    """Excited frequencies, and the number of periods."""

    low_Hz: float  # lowest frequency
    high_Hz: float  # highest frequency, below half the sampling rate
    period_s: float = 2.0  # length of a period; its inverse is the spacing of the lines
    periods: int = 4  # periods evaluated
    # Periods before the evaluation, enough for the slowest mode to decay to below the noise;
    # `frequency_response` checks.
    settling_periods: int = 1

    def __post_init__(self) -> None:
        check_positive("period", self.period_s, "s")
        if not 0.0 < self.low_Hz < self.high_Hz < math.inf:
            raise InvalidInput(
                f"band {self.low_Hz} to {self.high_Hz} Hz: give two frequencies above zero, "
                "the lower one first"
            )
        if self.low_Hz * self.period_s < 1.0 - 1e-9:
            raise InvalidInput(
                f"period of {self.period_s:g} s is shorter than one cycle of {self.low_Hz:g} Hz; "
                f"use {1.0 / self.low_Hz:.3g} s or longer, or a higher low end"
            )
        if self.periods < PERIODS_MIN:
            raise InvalidInput(
                f"{self.periods} periods: {PERIODS_MIN} or more are needed to separate the signal "
                "from the noise"
            )
        if self.settling_periods < 0:
            raise InvalidInput(f"settling periods are {self.settling_periods}; give 0 or more")

    def lines(self, sampling_Hz: float) -> tuple[int, Lines]:
        """Samples per period, and the line numbers inside the band.

        Raises:
            InvalidInput: the band passes half the sampling rate, or a period is not a whole number
                of samples.
        """
        check_positive("sampling rate", sampling_Hz, "Hz")
        samples = round(self.period_s * sampling_Hz)
        if abs(samples - self.period_s * sampling_Hz) > 1e-6 * samples:
            raise InvalidInput(
                f"period of {self.period_s} s is {self.period_s * sampling_Hz:.6g} samples; "
                f"use {samples / sampling_Hz:.9g} s, a whole number of samples"
            )
        if not self.high_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"band ends at {self.high_Hz:g} Hz; it must end below half the sampling rate, "
                f"{sampling_Hz / 2.0:g} Hz"
            )
        first = math.ceil(self.low_Hz * self.period_s - 1e-9)
        last = math.floor(self.high_Hz * self.period_s + 1e-9)
        return samples, np.arange(first, last + 1)


def multisine(
    sampling_Hz: float,
    band: Band,
    peak_N: float,
    *,
    slope: float = 0.0,
    corner_Hz: float = 0.0,
) -> BroadbandExcitation:
    """A sum of sines on odd lines, its phases chosen for a low crest factor.

    One random line out of every four odd ones is left unexcited, but neither the lowest nor the
    highest. Phases start from Schroeder's and are improved by clipping in the time domain (van der
    Ouderaa, Schoukens & Renneboog 1988).

    Args:
        sampling_Hz: Sampling rate.
        band: Frequencies and periods.
        peak_N: Peak of the signal, N.
        slope: Amplitudes are proportional to `(f/corner)^slope` above the corner and equal below
            it. A slope of 1 or 1.5 compensates the roll-off of a reel above its resonance.
        corner_Hz: Corner frequency; zero is the lowest line.

    Raises:
        InvalidInput: a value is out of its range, or the band holds fewer than eight odd lines.
    """
    check_positive("peak of the excitation", peak_N, "N")
    samples, lines = band.lines(sampling_Hz)
    odd = lines[lines % 2 == 1]
    if odd.size < 2 * ODD_GROUP:
        raise InvalidInput(
            f"the band holds {odd.size} odd lines; {2 * ODD_GROUP} or more are needed: use a "
            "longer period or a wider band"
        )
    inner = odd[1:-1]
    draws = np.random.default_rng(0).integers(0, ODD_GROUP, inner.size // ODD_GROUP)
    left_out = inner[np.arange(draws.size) * ODD_GROUP + draws]
    excited = np.setdiff1d(odd, left_out)
    frequency = excited * sampling_Hz / samples
    amplitude = np.maximum(frequency / max(corner_Hz, frequency[0]), 1.0) ** slope
    even = lines[lines % 2 == 0]
    period = peak_N * _low_crest(samples, excited, amplitude)
    segment = Segment(period, band.settling_periods, band.periods, excited, even, left_out)
    return BroadbandExcitation("multisine", sampling_Hz, (segment,))


def chirp(sampling_Hz: float, band: Band, peak_N: float) -> BroadbandExcitation:
    """A linear sweep through the band, repeated with opposite sign for odd lines only.

    Its crest factor is near sqrt(2), below a multisine's, but its spectrum cannot be shaped, and
    it shows even distortion only.

    Args:
        sampling_Hz: Sampling rate.
        band: Frequencies and periods; a period holds two sweeps.
        peak_N: Amplitude, N.

    Raises:
        InvalidInput: a value is out of its range, a period is an odd number of samples, or too
            short to sweep the band.
    """
    check_positive("peak of the excitation", peak_N, "N")
    samples, lines = band.lines(sampling_Hz)
    if samples % 2:
        raise InvalidInput(
            f"a period of {samples} samples cannot be halved; use "
            f"{(samples + 1) / sampling_Hz:.9g} s, an even number of samples"
        )
    half = samples // 2
    # Whole half-cycles make the sweeps join without a jump.
    cycles = (band.low_Hz + band.high_Hz) / 2.0 * half / sampling_Hz
    whole = round(cycles)
    odd = lines[lines % 2 == 1]
    if whole < 2 or odd.size < 2 * ODD_GROUP:
        raise InvalidInput(
            f"a period of {band.period_s:g} s is too short to sweep {band.low_Hz:g} to "
            f"{band.high_Hz:g} Hz; use a longer one"
        )
    t = np.arange(half) / half
    low = band.low_Hz * half / sampling_Hz
    sweep = peak_N * np.sin(2.0 * np.pi * (low * t + (whole - low) * t**2))
    segment = Segment(
        np.concatenate([sweep, -sweep]),
        band.settling_periods,
        band.periods,
        odd,
        lines[lines % 2 == 0],
        np.empty(0, np.int64),
    )
    return BroadbandExcitation("chirp", sampling_Hz, (segment,))


def stepped_sine(
    sampling_Hz: float, band: Band, peak_N: float, points: int = 20
) -> BroadbandExcitation:
    """Successive sines, evenly spaced in log frequency; their harmonics show distortion.

    One line at a time has the full amplitude: the lowest noise per line, and the longest record.

    Args:
        sampling_Hz: Sampling rate.
        band: Frequencies, and the periods at each of them.
        peak_N: Amplitude, N.
        points: Number of frequencies; those on the same line are measured once.
    """
    check_positive("peak of the excitation", peak_N, "N")
    if points < 2:
        raise InvalidInput(f"{points} points: a response needs two frequencies or more")
    samples, lines = band.lines(sampling_Hz)
    chosen = np.unique(np.rint(np.geomspace(lines[0], lines[-1], points)).astype(np.int64))
    k = np.arange(samples)
    segments = []
    for line in chosen:
        harmonics = np.arange(2 * line, (samples + 1) // 2, line)
        segments.append(
            Segment(
                peak_N * np.sin(2.0 * np.pi * line * k / samples),
                band.settling_periods,
                band.periods,
                np.array([line]),
                harmonics[::2],
                harmonics[1::2],
            )
        )
    return BroadbandExcitation("custom", sampling_Hz, tuple(segments))


def _low_crest(samples: int, lines: Lines, amplitude: FloatArray) -> FloatArray:
    """One period with these amplitudes and a peak of one, shape (samples,)."""
    power = amplitude**2 / (amplitude**2).sum()
    # Schroeder 1970: a sweep whose time at each line is proportional to the line's power.
    spent = np.concatenate([[0.0], np.cumsum(power)[:-1]])
    phase = -2.0 * np.pi * np.cumsum(spent)
    best, least = np.empty(0), math.inf
    for _ in range(CREST_ROUNDS):
        spectrum = np.zeros(samples // 2 + 1, np.complex128)
        spectrum[lines] = amplitude * np.exp(1j * phase)
        signal = np.fft.irfft(spectrum, samples)
        peak = np.abs(signal).max()
        if peak < least:
            best, least = signal / peak, peak
        phase = np.angle(np.fft.rfft(np.clip(signal, -CLIP * peak, CLIP * peak))[lines])
    return best
