"""Compensations of the hardware loop: in Python, as C, in the rig's file, and in records."""

import math
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estune.hardware.compensation.runtime import CompiledCompensation, PlainCompensation
from estune.reel.gravity import gravity_force_by_position_N
from estune.reel.velocity import motion
from tests.support_hardware import config

FRICTION = {"coulomb_Nm": 0.06, "static_Nm": 0.09, "stribeck_rad_s": 0.5}
ALL = {
    "friction": FRICTION,
    "inertia": {"inertia_kgm2": 0.002},
    "gravity": {"weight_N_m": 0.5, "rise_m": 0.4, "length_min_m": 0.5, "length_max_m": 1.4},
}
COUNT = 2.0 * math.pi / 8192


def rig_file(**compensation):
    return config(compensation=compensation or ALL)


@cache
def both():
    rig = rig_file()
    plan = rig.plan()
    return plan.compensation, plan.compensation_source


def drum(samples: int, rate_Hz: float = 632.0):
    """Times, tensions and angles of a drum that swings, in encoder counts."""
    times = np.arange(samples) / rate_Hz
    angles = COUNT * np.round(0.4 * np.sin(12.0 * times) / COUNT)
    return times, 15.0 + 8.0 * np.sin(31.0 * times), angles


@settings(max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.sampled_from((1.0 / 632.0, 0.003, -0.01, math.nan)) | st.floats(1e-4, 1e-2),
            st.floats(-20.0, 80.0) | st.just(math.nan),
            st.integers(-40, 40) | st.just(math.nan),
        ),
        min_size=5,
        max_size=60,
    )
)
def test_compiled_compensation_equals_the_plain_one(steps):
    plan, source = both()
    plain, compiled = PlainCompensation(plan), CompiledCompensation(source)
    time = 100.0
    for interval, tension, counts in steps:
        time = time + interval if math.isfinite(interval) else time
        at = time if math.isfinite(interval) else math.nan
        one = plain.sample(at, tension, counts * COUNT)
        two = compiled.sample(at, tension, counts * COUNT)
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-12)
        assert abs(one.feed_forward_N) <= plan.feed_forward_max_N * (1.0 + 1e-12)


def test_terms_are_those_of_the_equations():
    plan, source = both()
    times, tensions, angles = drum(300)
    compensation = CompiledCompensation(source)
    terms = np.array(
        [compensation.sample(*row) for row in zip(times, tensions, angles, strict=True)]
    )
    moved = motion(plan.windows, times, angles)
    radius = 0.025
    np.testing.assert_allclose(terms[:, 0], moved.velocity_rad_s, rtol=1e-12)
    np.testing.assert_allclose(
        terms[:, 1],
        gravity_force_by_position_N(0.5, 0.8 - radius * angles, rise_m=0.4, tension_1_N=tensions),
        rtol=1e-12,
    )
    np.testing.assert_allclose(terms[:, 2], plan.feed_forward.friction_Nm(moved) / radius)
    np.testing.assert_allclose(
        terms[:, 3], plan.feed_forward.inertia_Nm(moved) / radius, atol=1e-12
    )
    assert np.abs(terms).max(axis=0).min() > 0.1
