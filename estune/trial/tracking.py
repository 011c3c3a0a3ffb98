"""Tracking and rest: what a step's cost does not show of a loop.

A step hides friction: 0.05 N m of Coulomb friction adds 6 % to the cost of the reference reel's
tuned step, and makes the error at a reversal 4.8 times as large. A slow triangle shows tracking
and reversals, and the time after a step the rest.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.trial.description import RigLimits
from estune.trial.profiles import StepProfile, TriangleProfile

CYCLE_SETTLINGS = 15.0
"""Length of a triangle's cycle in settling times: slow beside the loop."""
AMPLITUDE_SHARE = 0.3
"""Amplitude of the triangle relative to the step."""
WIDE_SHARE = 0.8
"""Width of a triangle that is to turn the drum, relative to the range of the tension: the tenth
left at each end is for the error."""
WIDE = frozenset(("angle_map", "current_limit"))
"""Compensations that a triangle so wide is needed for."""
CYCLES = 3
"""Cycles of the triangle; the first one, which begins from rest, does not count."""
REVERSAL_SETTLINGS = 1.2
"""Time after a reversal within which its error is sought, in settling times."""
REST_SETTLINGS = 8.0
"""Length of the rest that is judged, in settling times; as long again is left for settling."""
REST_WINDOWS = 4
"""Parts of the rest, of which the median counts: a drum that sticks slips once in a while, by
0.2 N on a reel with 0.08 N m of friction, while hunting goes on in every part."""


class TriangleTracking(NamedTuple):
    """How a loop follows a slow triangle.

    Attributes:
        rms: Root mean square of the error after the first cycle.
        reversal: Mean over the reversals of the greatest error shortly after each.
    """

    rms: float
    reversal: float


def tracking_profile(
    step: StepProfile, settling_time_s: float, limits: RigLimits | None = None
) -> TriangleProfile:
    """The slow triangle that belongs to a rig's step: about the middle of it.

    Args:
        limits: Limits of the tension, within which the triangle is as wide as they allow; it then
            turns the drum as far as the tension can, which waves over its angle ask for, and asks
            for as much current as the rig may.
    """
    middle, amplitude = step.preload_N + 0.5 * step.step_N, AMPLITUDE_SHARE * step.step_N
    if limits is not None:
        low, high = limits.tension_min_N, limits.tension_max_N
        middle, amplitude = 0.5 * (low + high), 0.5 * WIDE_SHARE * (high - low)
    period = CYCLE_SETTLINGS * settling_time_s
    start = 2.0 * settling_time_s
    return TriangleProfile(
        preload_N=middle,
        amplitude_N=amplitude,
        period_s=period,
        duration_s=start + CYCLES * period,
        start_s=start,
    )


def resting_profile(step: StepProfile, settling_time_s: float) -> StepProfile:
    """The rig's step, and the time at rest after it."""
    after = max(step.duration_s - step.step_at_s, 2.0 * REST_SETTLINGS * settling_time_s)
    return replace(step, duration_s=step.step_at_s + after)


def tracking_of(
    profile: TriangleProfile, settling_time_s: float, sampling_Hz: float, error: FloatArray
) -> TriangleTracking:
    """Tracking of a triangle.

    Args:
        error: Setpoint less tension, shape (samples,); NaN is returned for one cut short.
    """
    if error.size < profile.samples(sampling_Hz) or not np.isfinite(error).all():
        return TriangleTracking(math.nan, math.nan)
    first = round((profile.start_s + profile.period_s) * sampling_Hz)
    span = round(REVERSAL_SETTLINGS * settling_time_s * sampling_Hz)
    turns_s = profile.start_s + profile.period_s * (np.arange(2 * CYCLES) / 2.0 + 0.25)
    places = [round(float(turn) * sampling_Hz) for turn in turns_s]
    found = [float(np.abs(error[at : at + span]).max()) for at in places if at >= first]
    return TriangleTracking(float(np.sqrt(np.mean(error[first:] ** 2))), float(np.mean(found)))


def rest_of(settling_time_s: float, sampling_Hz: float, measurement: FloatArray) -> float:
    """Standard deviation of the tension at rest, at the end of a `resting_profile`."""
    part = round(REST_SETTLINGS * settling_time_s * sampling_Hz) // REST_WINDOWS
    parts = measurement[-part * REST_WINDOWS :].reshape(REST_WINDOWS, part)
    return float(np.median(parts.std(axis=1)))
