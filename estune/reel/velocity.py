"""Velocity and acceleration of the drum from its encoder, by adaptive windowing.

First-order adaptive windowing (Janabi-Sharifi, Hayward & Chen 2000, end-fit form): the velocity is
the slope of the chord from the newest sample back over the longest window in which every sample
lies within the encoder's error of the chord. A slow drum gets a long window and a quiet estimate,
an accelerating one a short window and a small lag.

The acceleration is the same estimate of the velocities. Each velocity has the error bound of its
own window and the time of its middle, where it is exact at constant acceleration. Two thresholds,
as in Canny's edge detector (1986), separate it from encoder error: it is reported from a sample
above the strong threshold for as long as it stays above the weak one with the same sign, and is
zero otherwise. Canny also joins weak samples before a strong one, impossible in real time.

Error bounds. With angles within a peak-to-peak band e (one encoder count, at any rounding), a drum
at constant velocity gives

    |velocity - estimate| <= e / window,
    |acceleration estimate| <= (bound now + bound at the window's far end) / window:

the first because the errors of two angles differ by at most e, the second because the velocities
are within their bounds. Both are reported with the estimates. Thresholds are multiples of the
second bound, so that a drum at constant velocity never shows an acceleration.

The published test allows a sample the peak noise to either side of the chord. Its deviation may be
its own error plus that of the ends, so both are allowed here: the window of a drum at constant
velocity then always grows to its full length. Times are those of the samples, so that late samples
do not matter.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from estune.errors import InvalidInput

ROUNDING = 1.0 + 1e-9
"""Widens the band by the rounding of a count."""


@dataclass(frozen=True, slots=True)
class Windows:
    """The settings of the estimator.

    Attributes:
        angle_error_rad: Peak-to-peak error of the angle, rad: one encoder count, or more with a
            noisy encoder.
        velocity_intervals: Longest window of the velocity, in sampling intervals.
        acceleration_intervals: Longest window of the acceleration, in sampling intervals.
        weak: Threshold at which the acceleration ends, in error bounds; one or above.
        strong: Threshold at which it begins, in error bounds; weak or above.

    Raises:
        InvalidInput: a value is out of its range.
    """

    angle_error_rad: float
    velocity_intervals: int = 20
    acceleration_intervals: int = 20
    weak: float = 1.0
    strong: float = 2.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.angle_error_rad) and self.angle_error_rad > 0.0):
            raise InvalidInput(
                f"angle error is {self.angle_error_rad} rad; give the angle of one encoder count"
            )
        for name in ("velocity_intervals", "acceleration_intervals"):
            if getattr(self, name) < 1:
                raise InvalidInput(f"{name} is {getattr(self, name)}; it must be 1 or above")
        if not 1.0 <= self.weak <= self.strong < math.inf:
            raise InvalidInput(
                f"thresholds weak {self.weak} and strong {self.strong} must be finite, in order "
                "and 1 or above"
            )

    @property
    def half_band_rad(self) -> float:
        """Half the band of the angle's error, widened by the rounding of a count, rad."""
        return 0.5 * self.angle_error_rad * ROUNDING

    def acceleration_floor_rad_s2(self, sampling_Hz: float) -> float:
        """Least detectable acceleration with full windows, rad/s2."""
        spans_s2 = self.velocity_intervals * self.acceleration_intervals / sampling_Hz**2
        return self.strong * 2.0 * self.angle_error_rad / spans_s2


class DrumMotion(NamedTuple):
    """The drum's motion at a sample, or at each sample of a record (then arrays).

    Attributes:
        velocity_rad_s: Velocity; zero before two samples.
        velocity_bound_rad_s: Bound of its error at constant velocity; infinite before two samples.
        velocity_window_s: Length of its window; zero before two samples.
        acceleration_rad_s2: Acceleration; zero below its noise floor.
        acceleration_bound_rad_s2: Bound of the acceleration by encoder error alone.
    """

    velocity_rad_s: Any
    velocity_bound_rad_s: Any
    velocity_window_s: Any
    acceleration_rad_s2: Any
    acceleration_bound_rad_s2: Any


class MotionState(NamedTuple):
    """The state of the estimator between samples, newest first."""

    times_s: tuple[float, ...] = ()
    angles_rad: tuple[float, ...] = ()
    middles_s: tuple[float, ...] = ()
    velocities_rad_s: tuple[float, ...] = ()
    bounds_rad_s: tuple[float, ...] = ()
    direction: int = 0  # sign of the reported acceleration


def step(
    windows: Windows, state: MotionState, time_s: float, angle_rad: float
) -> tuple[MotionState, DrumMotion]:
    """One sample of the estimator.

    Args:
        state: After the last sample; `MotionState()` at the start.

    Raises:
        InvalidInput: the time or the angle is not finite, or time does not increase.
    """
    if not (math.isfinite(time_s) and math.isfinite(angle_rad)):
        raise InvalidInput(f"angle {angle_rad} rad at {time_s} s is not finite; leave it out")
    if state.times_s and not time_s > state.times_s[0]:
        raise InvalidInput(
            f"a sample at {time_s} s follows one at {state.times_s[0]} s; give them in time order"
        )
    intervals = max(windows.velocity_intervals, windows.acceleration_intervals)
    times = (time_s, *state.times_s[:intervals])
    angles = (angle_rad, *state.angles_rad[:intervals])
    half_band = (windows.half_band_rad,) * len(angles)
    velocity, bound, span = _longest_chord(times, angles, half_band, windows.velocity_intervals)
    middles = (time_s - 0.5 * span, *state.middles_s[:intervals])
    velocities = (velocity, *state.velocities_rad_s[:intervals])
    bounds = (bound, *state.bounds_rad_s[:intervals])
    raw, floor, _ = _longest_chord(middles, velocities, bounds, windows.acceleration_intervals)

    direction = int(raw > 0.0) - int(raw < 0.0)
    goes_on = direction == state.direction and abs(raw) >= windows.weak * floor
    counts = abs(raw) >= windows.strong * floor or goes_on
    following = MotionState(times, angles, middles, velocities, bounds, direction if counts else 0)
    return following, DrumMotion(velocity, bound, span, raw if counts else 0.0, floor)


def _longest_chord(
    times: tuple[float, ...],
    values: tuple[float, ...],
    errors: tuple[float, ...],
    intervals: int,
) -> tuple[float, float, float]:
    """Slope of the longest chord from the newest sample, its error bound, and its length in s.

    A chord back to sample n is within the errors of every sample i between if
    |values_i - values_0 - slope (t_i - t_0)| <= errors_0 + errors_i. Each gives a range of slopes,
    so one pass computes their intersection. A longer chord with a worse bound, because of a large
    error at its end, is not used. Middles of windows may be out of order; such pairs are skipped.
    """
    slope, bound, length = 0.0, math.inf, 0.0
    least, greatest = -math.inf, math.inf
    for n in range(1, min(intervals, len(times) - 1) + 1):
        span = times[0] - times[n]
        if not span > 0.0:
            continue
        candidate = (values[0] - values[n]) / span
        if not least <= candidate <= greatest:
            break
        error = errors[0] + errors[n]
        if error / span < bound:
            slope, bound, length = candidate, error / span, span
        least = max(least, candidate - error / span)
        greatest = min(greatest, candidate + error / span)
    return slope, bound, length


def motion(windows: Windows, time_s: ArrayLike, angle_rad: ArrayLike) -> DrumMotion:
    """The motion at each sample of a record, by `step`.

    Args:
        time_s: Times of the readings, s, shape (samples,).
        angle_rad: The angles, rad, shape (samples,).

    Returns:
        Arrays of shape (samples,).

    Raises:
        InvalidInput: a value is not finite, times do not increase, or the shapes do not match.
    """
    times = np.asarray(time_s, dtype=np.float64)
    angles = np.asarray(angle_rad, dtype=np.float64)
    if times.ndim != 1 or angles.shape != times.shape:
        raise InvalidInput(
            f"times have shape {times.shape} and angles {angles.shape}; "
            "give one time for each sample"
        )
    state, rows = MotionState(), []
    for instant, angle in zip(times.tolist(), angles.tolist(), strict=True):
        state, now = step(windows, state, instant, angle)
        rows.append(now)
    return DrumMotion(*np.array(rows).reshape(-1, len(DrumMotion._fields)).T)
