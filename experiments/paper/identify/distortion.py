"""Distortion by a nonlinear plant: its output on unexcited lines."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from experiments.paper.identify.spectra import SegmentSpectra

DISTORTION_P_VALUE = 1e-3
"""Significance level of distortion, which widens the confidence band."""


class HarmonicDistortion(NamedTuple):
    """Output of a nonlinear plant on unexcited lines."""

    frequency_Hz: FloatArray  # frequencies of the lines, ascending, shape (lines,)
    output_N: FloatArray  # amplitude of the output on each, N
    noise_N: FloatArray  # noise on each, rms of the amplitude, N
    share: float  # rms of the output in excess of the noise, relative to that on the excited lines
    p_value: float  # p-value of the hypothesis that the output is noise

    @property
    def detected(self) -> bool:
        """Whether the distortion is statistically significant."""
        return self.p_value < DISTORTION_P_VALUE


def measure_distortion(
    parts: list[SegmentSpectra], kind: str, line_Hz: float
) -> HarmonicDistortion | None:
    """Distortion on the unexcited even or odd lines."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    free = [getattr(part.segment, kind) for part in parts]
    if not any(lines.size for lines in free):
        return None
    spectra = np.concatenate([p.spectra[:, at] for p, at in zip(parts, free, strict=True)], axis=1)
    mean, periods = spectra.mean(axis=0), len(spectra)
    noise = np.sum(np.abs(spectra - mean) ** 2, axis=0) / (periods - 1) / periods
    power, floor, n = float(np.sum(np.abs(mean) ** 2)), float(noise.sum()), mean.size
    excited = np.concatenate([part.Y for part in parts])
    level = math.sqrt(max(0.0, power - floor) / n / float(np.mean(np.abs(excited) ** 2)))
    # Without noise, everything above rounding is distortion.
    rounding = n * float(np.abs(excited).max() * 1e-12) ** 2
    if floor > rounding:
        chance = float(fdtrc(2 * n, 2 * n * (periods - 1), power / floor))
    else:
        chance = 0.0 if power > rounding else 1.0
    order = np.argsort(np.concatenate(free), kind="stable")
    return HarmonicDistortion(
        np.concatenate(free)[order] * line_Hz,
        np.abs(mean)[order],
        np.sqrt(noise)[order],
        level,
        chance,
    )
