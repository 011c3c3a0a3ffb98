"""Metrics of a step response and of the response to a load.

The usual definitions, between two given values, so that they hold for any step, up or down, and
for a noisy record that may end before the steady state. python-control's `step_info` is for ideal
responses from zero.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray

STEADY_SHARE = 10
"""The last tenth of the samples after the step counts as steady state: its mean gives the error,
and a settled response stays in the band throughout."""

BAND = 0.02
"""Half-width of the settling band without noise, as a fraction of the step: the usual 2 %."""

NOISE_SIGMAS = 4.0
WIDEST_NOISE_BAND = 0.05
"""Noise widens the settling band to four standard deviations of the measurement before the step,
or one sample in a hundred would decide. The limit is 5 % of the step, the widest band in common
use, so that a loop that oscillates before the step does not count as settled."""


SMOOTHED, PEAK_DEGREE, FEWEST_OF_PEAK = 5, 4, 8
"""Samples of a mean, degree of the polynomial through a peak and the fewest samples it needs. With
noise of 0.4 % of the step it is at most 0.2 % too high on average, the largest sample 0.7 %."""


class StepMetrics(NamedTuple):
    """Metrics of one step response; NaN where undefined.

    Attributes:
        rise_time_s: From 10 % to 90 % of the step, s; NaN if 90 % is not reached.
        settling_time_s: From the step until the response stays in the band, s; NaN if it leaves
            it in the last tenth of the samples. Noise before the step widens the band, to 5 % at
            most.
        overshoot: Peak past the final value without its noise, as a fraction of the step; zero
            if there is none.
        steady_state_error: Final value less the mean over the last tenth of the samples after the
            step, in the unit of the measurement.
        undershoot: Peak before the initial value, on the side away from the final one, as a
            fraction of the step; zero where noise explains it.
        iae: Integral of the absolute difference from the final value, from the step on, in the
            unit of the measurement times s; noise included.
    """

    rise_time_s: float
    settling_time_s: float
    overshoot: float
    steady_state_error: float
    undershoot: float
    iae: float


NO_METRICS = StepMetrics(*(math.nan,) * 6)


def step_metrics(
    time_s: ArrayLike,
    measurement: ArrayLike,
    *,
    step_time_s: float,
    initial: float,
    final: float,
    band: float = BAND,
) -> StepMetrics:
    """Metrics of a step response between its initial and its final setpoint.

    Bad data are not an error: with a value that is not finite, fewer than two samples after the
    step, times that do not increase, columns of different length, or no step at all, every metric
    is NaN. Times between samples are interpolated linearly.

    Args:
        time_s: Time of each sample, s, shape (samples,).
        measurement: Measured response, shape (samples,), any unit.
        initial: Setpoint before the step, in the unit of the measurement.
        final: Setpoint after the step.
        band: Half-width of the settling band without noise, as a fraction of the step.
    """
    time = np.asarray(time_s, dtype=np.float64)
    values = np.asarray(measurement, dtype=np.float64)
    span = final - initial
    if time.ndim != 1 or time.shape != values.shape or not math.isfinite(span) or span == 0.0:
        return NO_METRICS
    if not ((time[1:] > time[:-1]).all() and math.isfinite(step_time_s)):
        return NO_METRICS
    first = int(time.searchsorted(step_time_s))
    t, tail = time[first:], values[-steady_samples(len(values) - first) :]
    with np.errstate(over="ignore", invalid="ignore"):  # of a diverged response
        shares = (values - initial) / span
        before, z = shares[:first], shares[first:]
        if len(z) < 2 or not np.isfinite(shares).all():
            return NO_METRICS
        noise = _deviation(before)
        noise_band = min(NOISE_SIGMAS * noise, WIDEST_NOISE_BAND)
        return StepMetrics(
            rise_time_s=_rise_time(t, z),
            settling_time_s=_settling_time(t, z, max(band, noise_band)) - step_time_s,
            overshoot=max(0.0, _peak(z, noise) - 1.0),
            steady_state_error=float(final - tail.sum() / len(tail)),
            undershoot=_peak(1.0 - z, noise) - 1.0 if z.min() < -NOISE_SIGMAS * noise else 0.0,
            iae=abs(span) * float(np.trapezoid(np.abs(1.0 - z), t)),
        )


class LoadMetrics(NamedTuple):
    """Metrics of the response to a load at rest.

    Attributes:
        peak: Largest deviation from the setpoint, noise included, in the unit of the measurement.
        recovery_time_s: From the load until the response stays in the band, as of a settling
            time, s; NaN if it leaves it in the last tenth of the samples.
    """

    peak: float
    recovery_time_s: float


def load_metrics(
    time_s: FloatArray,
    measurement: FloatArray,
    *,
    step: int,
    load: int,
    initial: float,
    final: float,
) -> LoadMetrics:
    """Metrics of the response to a load that follows a step; data as of `step_metrics`.

    Args:
        time_s: Time of each sample, s, shape (samples,).
        measurement: Measured response, shape (samples,), any unit; finite.
        step: First sample of the step.
        load: First sample of the load.
        initial: Setpoint before the step, in the unit of the measurement.
        final: Setpoint after it.
    """
    shares = (measurement - initial) / (final - initial)
    noise_band = min(NOISE_SIGMAS * _deviation(shares[:step]), WIDEST_NOISE_BAND)
    t, z = time_s[load:], shares[load:]
    recovered_s = _settling_time(t, z, max(BAND, noise_band)) - float(t[0])
    return LoadMetrics(float(np.abs(measurement[load:] - final).max()), recovered_s)


def _peak(z: FloatArray, noise: float) -> float:
    """Largest value of a response without its noise, whose standard deviation is given.

    A polynomial through the samples of the upper half of the peak; the largest sample where these
    are few, and where the noise explains the peak the largest mean of `SMOOTHED` samples.
    """
    largest = float(z.max())
    if len(z) < SMOOTHED or noise == 0.0:
        return largest
    sums = np.concatenate([[0.0], np.cumsum(z)])
    means = (sums[SMOOTHED:] - sums[:-SMOOTHED]) / SMOOTHED
    at, top = int(means.argmax()), float(means.max())
    if largest - 1.0 < NOISE_SIGMAS * noise:
        return top
    low = means <= 1.0 + 0.5 * (top - 1.0)
    after = int(low[at:].argmax()) if low[at:].any() else len(low)
    before = int(low[at::-1].argmax()) if low[: at + 1].any() else at + 1
    peak = z[at - before + 1 + SMOOTHED // 2 : at + after + SMOOTHED // 2]
    if len(peak) < FEWEST_OF_PEAK:
        return largest
    place = np.linspace(-1.0, 1.0, len(peak))
    powers = np.vander(place, PEAK_DEGREE + 1)
    basis, _ = np.linalg.qr(powers)
    return float((basis @ (basis.T @ peak)).max())


def _deviation(values: FloatArray) -> float:
    """Standard deviation, in a third of the time of `std`; zero if empty."""
    if not len(values):
        return 0.0
    centred = values - values.sum() / len(values)
    return math.sqrt(centred.dot(centred) / len(values))


def _rise_time(t: FloatArray, z: FloatArray) -> float:
    """Time from the last sample below 10 % before the first crossing of 90 %, to that crossing."""
    above = z >= 0.9
    high = int(above.argmax())
    if not above[high]:
        return math.nan
    below = z[:high] <= 0.1
    low = high - 1 - int(below[::-1].argmax()) if below.any() else -1
    return _crossing(t, z, high - 1, 0.9) - _crossing(t, z, low, 0.1)


def _settling_time(t: FloatArray, z: FloatArray, band: float) -> float:
    """Time from which the response stays within the band; NaN if it does not."""
    outside = np.abs(z - 1.0) > band
    if not outside.any():
        return float(t[0])
    last = len(z) - 1 - int(outside[::-1].argmax())
    if last >= len(z) - steady_samples(len(z)):
        return math.nan
    return _crossing(t, z, last, 1.0 + math.copysign(band, z[last] - 1.0))


def steady_samples(after_step: int) -> int:
    """Samples of the steady state, of so many after the step."""
    return max(1, after_step // STEADY_SHARE)


def _crossing(t: FloatArray, z: FloatArray, before: int, level: float) -> float:
    """Time at which the line from a sample to the next meets the level; the first time for -1."""
    if before < 0:
        return float(t[0])
    z0, z1 = float(z[before]), float(z[before + 1])
    t0, t1 = float(t[before]), float(t[before + 1])
    return t0 + (t1 - t0) * (level - z0) / (z1 - z0)
