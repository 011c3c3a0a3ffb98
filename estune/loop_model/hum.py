"""Frequency of a hum in the measurement: a line that stands at rest as well as after the step.

The hum of the mains is no answer of the plant. Taken for one it looks like a mode without damping,
which leaves no gains within the limits.
"""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.records import LoopRecord

CHANCE = 1e-3
"""Probability that noise is taken for a hum at rest, and again in the tail."""

LEAST_SAMPLES = 16
"""Samples at rest from which a hum can be seen."""

PADDED = 8
"""Length of the spectrum over that of the tail, so that a peak is resolved to a part of a bin."""

BESIDE = (3, 13)
"""Bins to both sides of a line by which its noise is judged; a line through a Hann window is four
bins wide, the resonance of a loop many."""


def hum_of(records: Sequence[LoopRecord]) -> float:
    """Frequency of the hum in step trials from rest, rad/sample; zero where there is none."""
    steps = [r for r in records if r.at_rest and r.step_index >= LEAST_SAMPLES and _is_step(r)]
    if not steps:
        return 0.0
    rest = min(r.step_index for r in steps)
    tail = min(r.samples - r.step_index for r in steps) // 2
    if tail < 4 * BESIDE[1]:
        return 0.0
    theta = _line(np.array([r.measurement[-tail:] for r in steps]))
    before = np.array([r.measurement[r.step_index - rest : r.step_index] for r in steps])
    return theta if theta * rest > 2.0 * math.pi and _holds(before, theta) else 0.0


def _is_step(record: LoopRecord) -> bool:
    return not np.ptp(record.setpoint[record.step_index :])


def _line(tails: FloatArray) -> float:
    """Frequency of the line that stands out most from its neighbours; zero without one."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    count, samples = tails.shape
    windowed = (tails - tails.mean(axis=1, keepdims=True)) * np.hanning(samples)
    power = np.sum(np.abs(np.fft.rfft(windowed, axis=1)) ** 2, axis=0)
    near, far = BESIDE
    bins = np.arange(far, power.size - far)
    beside = [power[bins + side * k] for side in (-1, 1) for k in range(near, far)]
    ratios = power[bins] / np.maximum(np.mean(beside, axis=0), 1e-300)
    at = int(bins[ratios.argmax()])
    # Neighbours through a Hann window are not independent: as many as half of them.
    chance = float(fdtrc(2 * count, count * (far - near) * 2, float(ratios.max())))
    if chance * bins.size > CHANCE:
        return 0.0
    fine = np.sum(np.abs(np.fft.rfft(windowed, PADDED * samples, axis=1)) ** 2, axis=0)
    low = PADDED * (at - 1)
    peak = low + int(fine[low : PADDED * (at + 1) + 1].argmax())
    left, middle, right = np.log(fine[peak - 1 : peak + 2])
    shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
    return float(2.0 * math.pi * (peak + shift) / (PADDED * samples))


def _holds(before: FloatArray, theta: float) -> bool:
    """Whether the samples at rest, shape (records, samples), hold a line of this frequency."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    count, samples = before.shape
    angles = theta * np.arange(samples)
    basis, _ = np.linalg.qr(np.stack([np.ones(samples), np.cos(angles), np.sin(angles)], axis=1))
    parts = before @ basis
    line, total = float(np.sum(parts[:, 1:] ** 2)), float(np.sum(before**2))
    rounding = total * float(np.finfo(float).eps)
    noise = max(total - float(np.sum(parts**2)), rounding) / (samples - 3)
    if noise == 0.0:  # a simulated plant without noise rests at zero
        return False
    return bool(fdtrc(2 * count, count * (samples - 3), line / (2.0 * noise)) < CHANCE)
