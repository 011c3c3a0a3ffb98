"""The steps of the converter that a measurement comes from, where no two readings show them.

The mean of several readings of a converter lies between its steps while the signal passes them,
and rests on them otherwise: the smallest difference in the log is that of the mean. What shows the
steps is where within a step the values gather, at every level alike.
"""

import numpy as np

from estune.core.quantities import FloatArray

LEAST_MOVES, MOST_MOVES = 4.0, 20.0
"""Steps that are looked for, in median moves from sample to sample: those of a measured chamber
are 8 to 20. Noise of more than a quarter of a step leaves nothing of it."""

LEVELS, SAMPLES = 12, 4
"""Fewest steps that are passed, and samples in each that counts."""

GATHERED = 0.5
"""Mean over the levels of the phase within a step, zero for values that are spread evenly. It is
0.53 to 0.69 in eleven logs of a chamber and at most 0.37 in 18 measurements without such steps."""

BINS, CANDIDATES, FINE = 16, 6, 5
"""Bins of the shortest step, peaks of the spectrum of the levels that are looked at, and steps
that are tried about each."""


def converter_step(measurement: FloatArray) -> float:
    """Step of the converter behind averaged readings, in its unit; zero where none shows."""
    moves = np.abs(np.diff(measurement))
    median = float(np.median(moves[moves > 0.0])) if moves.any() else 0.0
    values = measurement - measurement.min()
    span = float(values.max())
    least, most = LEAST_MOVES * median, min(MOST_MOVES * median, span / LEVELS)
    if not 0.0 < least < most:
        return 0.0
    width = least / BINS
    # The logarithm, so that levels count that are passed beside those held at the setpoints.
    visits = np.log1p(np.bincount((values / width).astype(int)))
    padded = 4 * visits.size
    power = np.abs(np.fft.rfft(visits, padded)) ** 2
    low, high = (round(padded * width / step) for step in (most, least))
    peaks = low + np.argsort(-power[low : high + 1])[:CANDIDATES]
    rates = (peaks[:, np.newaxis] + np.linspace(-0.5, 0.5, FINE)).ravel() / (padded * width)
    best = max(rates.tolist(), key=lambda rate: _gathered(values, rate))
    return 1.0 / best if _gathered(values, best) > GATHERED else 0.0


def _gathered(values: FloatArray, rate: float) -> float:
    """Size of the mean phase of values within steps of 1/rate, each step counted once."""
    phases = values * rate
    level, waves = phases.astype(int), np.exp(2j * np.pi * phases)
    visits = np.bincount(level)
    counted = visits >= SAMPLES
    if np.count_nonzero(counted) < LEVELS:
        return 0.0
    sums = np.bincount(level, waves.real) + 1j * np.bincount(level, waves.imag)
    return float(np.abs(np.mean(sums[counted] / visits[counted])))
