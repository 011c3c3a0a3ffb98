"""Excitation of the hidden machines: forces in N about a mean, or angles in rad."""

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]


def steps(rate: float, seconds: float, levels: list[float], lead_s: float = 0.2) -> Column:
    """Levels held one after the other for equal times, the first for `lead_s` more."""
    total = round(seconds * rate)
    each = (seconds - lead_s) / len(levels)
    t = np.arange(total) / rate
    place = np.clip(((t - lead_s) / each).astype(int), 0, len(levels) - 1)
    held: Column = np.array(levels, float)[place]
    return held


def triangle(rate: float, seconds: float, mean: float, size: float, turns: int) -> Column:
    """Straight up and down, from the mean and back to it."""
    phase = np.arange(round(seconds * rate)) / round(seconds * rate) * turns
    there: Column = mean + size * (1.0 - 4.0 * np.abs((phase + 0.25) % 1.0 - 0.5))
    return there


def sweep(
    rate: float, seconds: float, mean: float, size: float, *, low: float, high: float
) -> Column:
    """A sine whose frequency grows in equal ratios in equal times."""
    t = np.arange(round(seconds * rate)) / rate
    growth = np.log(high / low)
    turns = low * seconds / growth * np.expm1(growth * t / seconds)
    there: Column = mean + size * np.sin(2.0 * np.pi * turns)
    return there


def multisine(
    rng: np.random.Generator,
    rate: float,
    period_s: float,
    periods: int,
    mean: float,
    *,
    rms: float,
    high_Hz: float,
) -> Column:
    """Odd lines with random phases, one of four left out; even lines are never excited.

    The amplitude falls up to 4 Hz, stays even, and rises again above 40 Hz, where the machine
    follows less and less.
    """
    samples = round(period_s * rate)
    lines = np.arange(1, min(int(high_Hz * period_s), samples // 2 - 1), 2)
    groups = lines[: lines.size // 4 * 4].reshape(-1, 4)
    left_out = groups[np.arange(len(groups)), rng.integers(0, 4, len(groups))]
    lines = np.setdiff1d(lines, left_out)
    f = lines / period_s
    spectrum = np.zeros(samples // 2 + 1, complex)
    shape = np.sqrt(1.0 + (f / 40.0) ** 2) * np.sqrt(1.0 + (2.0 / f) ** 2)
    spectrum[lines] = shape * np.exp(2j * np.pi * rng.random(lines.size))
    wave = np.fft.irfft(spectrum, samples)
    return mean + np.tile(wave * (rms / wave.std()), periods)


def reversals(
    rng: np.random.Generator, rate: float, seconds: float, mean: float, dip: float
) -> Column:
    """A mean with dips to below zero now and then, each made up for by as much above the mean.

    Dips last 60 to 140 ms, what lies between them 0.25 to 0.5 s.
    """
    level = mean
    out: list[Column] = []
    total = round(seconds * rate)
    while sum(part.size for part in out) < total:
        out.append(np.full(round(rng.uniform(0.25, 0.5) * rate), level))
        short = round(rng.uniform(0.06, 0.14) * rate)
        out.append(np.full(short, mean - rng.uniform(0.8, 1.4) * (mean + dip)))
    there: Column = np.concatenate(out)[:total]
    return there


def smooth_steps(rate: float, seconds: float, levels: list[float], ramp_s: float) -> Column:
    """Levels joined by ramps that start and end gently."""
    raw = steps(rate, seconds, levels)
    width = max(3, round(ramp_s * rate))
    window = np.hanning(width + 2)[1:-1]
    padded = np.concatenate([np.full(width, raw[0]), raw])
    return np.convolve(padded, window / window.sum())[width : width + raw.size]
