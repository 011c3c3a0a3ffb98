"""A multisine."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Excitation, Loop, check

Lines = Literal["all", "odd", "odd_sparse"]

ODD_GROUP = 4
"""Size of the groups of odd lines of which `odd_sparse` omits one."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
PEAK_SAMPLES = 16
"""Samples per period of the highest line on which the peak is computed."""
MOST_LINES = 2000
STEEPEST = 4.0


@dataclass(frozen=True, slots=True)
class MultisineProfile(Excitation):
    """A sum of sines on the lines of a period, with the low peak of Schroeder's phases.

    Line l lies at f_l = l/period_s. The excited lines are those from `first_line` to `last_line`
    that `lines` names: `all`; `odd`, which leaves the even lines to even distortion; `odd_sparse`,
    which also leaves one of every four odd lines out, to show odd distortion: of the m-th complete
    group of four, m from 0, the one at place floor(4 frac((m + 1) (sqrt(5) - 1)/2)), from 0.

    With the weights w_l = max(f_l/corner_Hz, 1)^slope (1 where the slope is 0), their share of
    power p_l = w_l^2/sum w^2, and the excited lines in rising order,

        phi_l    = -2 pi sum over the lines i up to l of the sum of p over the lines before i
        setpoint = preload_N + rms_N sum_l sqrt(2 p_l) sin(2 pi f_l s + phi_l)

    (Schroeder, IEEE Trans. Information Theory 16 (1970) 85). A trial whose period is a whole
    number of samples, and whose duration is the start and whole periods, has no leakage.

    Attributes:
        preload_N: Mean setpoint.
        rms_N: Root mean square of the signal about the mean; above zero.
        period_s: Length of a period, s; above zero.
        first_line: Lowest line, from 1.
        last_line: Highest line; below half the sampling rate.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        lines: Which of the lines are excited.
        slope: Exponent of the amplitudes over frequency above the corner; 1 to 1.5 suits a reel,
            whose response falls off with f^2.
        corner_Hz: Corner frequency of the slope; above zero.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    rms_N: float
    period_s: float
    first_line: int
    last_line: int
    duration_s: float
    start_s: float = 0.0
    lines: Lines = "all"
    slope: float = 0.0
    corner_Hz: float = 1.0
    loop: Loop = "closed"
    kind: Literal["multisine"] = "multisine"

    def __post_init__(self) -> None:
        check(self, ("rms_N",), ("period_s", "rms_N", "corner_Hz"))
        if not 1 <= self.first_line <= self.last_line <= MOST_LINES:
            raise InvalidInput(
                f"multisine profile: lines {self.first_line} to {self.last_line}; they must rise "
                f"from 1 or above to at most {MOST_LINES}"
            )
        if not self.excited.size:
            raise InvalidInput(
                f"multisine profile: no {self.lines} line lies from {self.first_line} to "
                f"{self.last_line}; use a wider band"
            )
        if not abs(self.slope) <= STEEPEST:
            raise InvalidInput(
                f"multisine profile: slope is {self.slope}; it must lie within {STEEPEST:g}"
            )

    @property
    def excited(self) -> NDArray[np.int64]:
        """The lines that carry the signal, rising."""
        return _excited(self.first_line, self.last_line, self.lines)

    @property
    def last_Hz(self) -> float:
        """Frequency of the highest line."""
        return self.last_line / self.period_s

    @property
    def extremes(self) -> tuple[float, float]:
        """Bounds of the setpoint, N: held between any samples, and at most 2 % too wide."""
        size = self.rms_N * _multisine_peak(
            *(self.first_line, self.last_line, self.lines, self.slope),
            self.corner_Hz * self.period_s,
        )
        return self.preload_N - size, self.preload_N + size

    def _deviation(self, s: FloatArray, sampling_Hz: float) -> FloatArray:
        if not self.last_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"multisine profile: its highest line is at {self.last_Hz:g} Hz; it must lie "
                f"below half the sampling rate, {sampling_Hz / 2.0:g} Hz"
            )
        amplitude, phase = _amplitudes_and_phases(
            self.excited, self.slope, self.corner_Hz * self.period_s
        )
        total = np.zeros(s.size)
        for l, a, phi in zip(self.excited, amplitude, phase, strict=True):
            total += a * np.sin(2.0 * np.pi * l / self.period_s * s + phi)
        return np.asarray(self.rms_N * total)


@lru_cache(maxsize=64)
def _excited(first: int, last: int, which: Lines) -> NDArray[np.int64]:
    """The excited lines, rising and read-only."""
    lines = np.arange(first, last + 1)
    if which != "all":
        lines = lines[lines % 2 == 1]
    if which == "odd_sparse":
        group = np.arange(lines.size // ODD_GROUP)
        place = np.floor(ODD_GROUP * np.mod((group + 1) * GOLDEN, 1.0)).astype(np.int64)
        lines = np.delete(lines, group * ODD_GROUP + place)
    lines.flags.writeable = False
    return lines


def _amplitudes_and_phases(
    lines: NDArray[np.int64], slope: float, corner_line: float
) -> tuple[FloatArray, FloatArray]:
    """sqrt(2 p_l) and phi_l of each line, for a signal of rms one."""
    weight = np.maximum(lines / corner_line, 1.0) ** slope
    power = weight**2 / (weight**2).sum()
    before = np.concatenate([[0.0], np.cumsum(power)[:-1]])
    return np.sqrt(2.0 * power), -2.0 * np.pi * np.cumsum(before)


@lru_cache(maxsize=64)
def _multisine_peak(
    first: int, last: int, which: Lines, slope: float, corner_line: float
) -> float:
    """A bound on the size of the multisine of rms one.

    On a grid of m points in a period of the highest line, the largest value misses the peak by no
    more than a factor of cos(pi/m) (Ehlich & Zeller, Math. Zeitschrift 86 (1964) 41).
    """
    lines = _excited(first, last, which)
    amplitude, phase = _amplitudes_and_phases(lines, slope, corner_line)
    points = PEAK_SAMPLES * last
    spectrum = np.zeros(points // 2 + 1, np.complex128)
    spectrum[lines] = -0.5j * points * amplitude * np.exp(1j * phase)  # sine, not cosine
    peak = float(np.abs(np.fft.irfft(spectrum, points)).max())
    return peak / math.cos(math.pi / PEAK_SAMPLES)
