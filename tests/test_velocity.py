import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estune.errors import InvalidInput
from estune.reel.velocity import MotionState, Windows, motion, step

RATE = 632.0
COUNT = 2.0 * math.pi / 8192.0
WINDOWS = Windows(COUNT)


def times(samples, seed=None):
    """Sampling instants; a seed adds the delays of an interrupt handler."""
    clock = np.arange(samples) / RATE
    return (
        clock
        if seed is None
        else clock + np.random.default_rng(seed).uniform(0, 0.3 / RATE, samples)
    )


def quantise(angle, phase=0.0):
    return (np.floor(angle / COUNT + phase)) * COUNT


@settings(max_examples=60)
@given(
    velocity=st.floats(-30.0, 30.0),
    phase=st.floats(0.0, 1.0),
    longest=st.integers(1, 30),
    seed=st.integers(0, 1000),
)
def test_constant_velocity_error_is_one_count_per_window(velocity, phase, longest, seed):
    t = times(120, seed)
    estimate = motion(Windows(COUNT, longest, longest), t, quantise(velocity * t, phase))
    span = t - t[np.maximum(np.arange(120) - longest, 0)]
    assert np.allclose(estimate.velocity_window_s, span, rtol=0, atol=1e-12)  # never shortened
    valid = span > 0.0
    error = np.abs(estimate.velocity_rad_s - velocity)[valid]
    assert (error <= COUNT / span[valid] * (1.0 + 1e-6)).all()
    assert (estimate.acceleration_rad_s2 == 0.0).all()


@settings(max_examples=40)
@given(
    acceleration=st.floats(10.0, 500.0), phase=st.floats(0.0, 1.0), sign=st.sampled_from([-1, 1])
)
def test_constant_acceleration_shrinks_the_window_within_bounds(acceleration, phase, sign):
    t = times(200)
    estimate = motion(WINDOWS, t, quantise(sign * 0.5 * acceleration * t**2, phase))
    # A chord over tau departs from the parabola by a (tau^2 - T^2)/8 at least; two counts go by.
    assert (
        estimate.velocity_window_s <= math.sqrt(16.0 * COUNT / acceleration + 1 / RATE**2) + 1e-9
    ).all()
    valid = estimate.velocity_window_s > 0.0
    middle = sign * acceleration * (t - 0.5 * estimate.velocity_window_s)
    off = np.abs(estimate.velocity_rad_s - middle)[valid]
    assert (off <= estimate.velocity_bound_rad_s[valid] * (1.0 + 1e-6)).all()
    counts = estimate.acceleration_rad_s2 != 0.0
    evident = acceleration >= (1.0 + WINDOWS.strong) * estimate.acceleration_bound_rad_s2
    assert evident[60:].any()
    assert counts[evident].all()
    off = np.abs(estimate.acceleration_rad_s2 - sign * acceleration)[counts]
    assert (off <= estimate.acceleration_bound_rad_s2[counts] * (1.0 + 1e-6)).all()


def noisy_record():
    t = times(400, seed=3)
    rng = np.random.default_rng(4)
    slow_then_fast = 0.05 * np.sin(3 * t) + np.where(t > 0.3, 3.0 * (t - 0.3) ** 2, 0.0)
    return t, slow_then_fast + rng.uniform(0.0, COUNT, t.size)


def test_window_is_that_of_the_definition():
    t, angle = noisy_record()
    estimate = motion(WINDOWS, t, angle)
    for k in range(1, t.size):
        expected = 0.0
        for n in range(1, min(WINDOWS.velocity_intervals, k) + 1):
            between = slice(k - n, k + 1)
            chord = np.interp(t[between], t[[k - n, k]], angle[[k - n, k]])
            if np.abs(angle[between] - chord).max() > COUNT:
                break
            expected = (angle[k] - angle[k - n]) / (t[k] - t[k - n])
        assert estimate.velocity_rad_s[k] == expected


def test_acceleration_is_one_connected_interval():
    t = times(700)
    # At 2 rad/s, then 40 rad/s2 for 0.3 s, then at constant velocity again.
    gained = np.clip(t - 0.4, 0.0, 0.3)
    angle = 2.0 * t + 40.0 * (0.5 * gained**2 + gained * np.clip(t - 0.7, 0.0, None))
    acceleration = motion(WINDOWS, t, quantise(angle)).acceleration_rad_s2
    counts = np.flatnonzero(acceleration)
    assert (np.diff(counts) == 1).all()
    assert (acceleration[counts] > 0.0).all()
    windows_s = (WINDOWS.velocity_intervals + WINDOWS.acceleration_intervals) / RATE
    assert 0.4 <= t[counts[0]] <= 0.4 + windows_s
    assert 0.7 - 1 / RATE <= t[counts[-1]] <= 0.7 + windows_s


def test_slow_motion_shows_no_acceleration():
    t = times(2000)
    floor = WINDOWS.acceleration_floor_rad_s2(RATE)
    for share, shows in ((0.3, False), (3.0, True)):
        w = 2.0 * math.pi
        estimate = motion(WINDOWS, t, quantise(share * floor / w**2 * np.sin(w * t), 0.5))
        assert (estimate.acceleration_rad_s2 != 0.0).any() == shows


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Windows(0.0), "one encoder count"),
        (lambda: Windows(math.nan), "one encoder count"),
        (lambda: Windows(COUNT, velocity_intervals=0), "velocity_intervals is 0"),
        (lambda: Windows(COUNT, weak=2.0, strong=1.0), "in order"),
        (lambda: Windows(COUNT, weak=math.nan), "thresholds"),
        (lambda: step(WINDOWS, MotionState(), 0.0, math.nan), "not finite"),
        (lambda: step(WINDOWS, step(WINDOWS, MotionState(), 1.0, 0.0)[0], 1.0, 0.0), "time order"),
        (lambda: motion(WINDOWS, [0.0, 1.0], [0.0, math.inf]), "not finite"),
        (lambda: motion(WINDOWS, [0.0, 0.0], [0.0, 1.0]), "time order"),
        (lambda: motion(WINDOWS, [0.0, 1.0], [0.0, 1.0, 2.0]), "one time for each sample"),
    ],
)
def test_bad_input_is_refused_with_its_remedy(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
