"""A line or steps in the disturbance that a linear loop leaves."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray


class SpectralLine(NamedTuple):
    """A sinusoid in a signal.

    Attributes:
        angle: Angle per sample.
        share: Share of the signal's variance.
        sharpness: Share of the power about the line that lies within the width of the window: a
            line of constant period has nearly one, a resonance driven by noise less.
    """

    angle: float
    amplitude: float
    share: float
    sharpness: float


def line(x: FloatArray) -> SpectralLine:
    """The strongest line of a signal with at least four periods in it."""
    count = x.size
    level = x - np.polynomial.Polynomial.fit(np.arange(count), x, 1)(np.arange(count))
    window = np.hanning(count)
    power = np.abs(np.fft.rfft(level * window)) ** 2
    power[:4] = 0.0
    at = int(np.argmax(power))
    near, wide = (
        slice(max(at - 2, 0), at + 3),
        slice(max(at - max(6, at // 3), 0), at + max(6, at // 3) + 1),
    )
    share = float(power[near].sum() / (np.sum((level * window) ** 2) * count / 2 + 1e-300))
    sharpness = float(power[near].sum() / (power[wide].sum() + 1e-300))
    angle = 2.0 * np.pi * at / count
    amplitude = float(np.sqrt(2.0 * min(share, 1.0) * np.mean(level**2)))
    return SpectralLine(angle, amplitude, min(share, 1.0), sharpness)


class Jump(NamedTuple):
    """A sudden change of the disturbance.

    Attributes:
        at: Sample.
        size: Of the disturbance at the measurement.
        score: Size over the deviation of sums of errors of that length.
    """

    at: int
    size: float
    score: float


def jump(errors: FloatArray, setpoint: FloatArray, length: int) -> Jump:
    """The most unlikely sum of prediction errors over some lengths, away from setpoint changes."""
    moved = np.abs(np.diff(setpoint, prepend=setpoint[0])) > 0.0
    near = np.convolve(moved, np.ones(4 * length + 1), "full")[: errors.size] > 0.0
    deviation = 1.4826 * float(np.median(np.abs(errors[errors != 0.0]))) if errors.any() else 1.0
    best = Jump(0, 0.0, 0.0)
    for width in {1, max(length // 2, 1), max(length, 1)}:
        sums = np.convolve(errors, np.ones(width), "valid")
        free = ~near[width - 1 :]
        if not free.any():
            continue
        sums = np.where(free, sums, 0.0)
        at = int(np.argmax(np.abs(sums)))
        score = abs(float(sums[at])) / (deviation * width**0.5 + 1e-300)
        if score > best.score:
            best = Jump(at, float(sums[at]), score)
    return best
