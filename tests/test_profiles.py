"""Setpoint profiles of trials."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.errors import InvalidInput
from estune.trial.profiles import (
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    StepProfile,
    TriangleProfile,
)

RATE_HZ = 500.0
TRIANGLE = TriangleProfile(15.0, 4.0, 1.0, 3.2, 0.2, shrink=0.5)
MULTISINE = MultisineProfile(15.0, 2.0, 2.0, 1, 120, 6.5, 0.5, lines="odd_sparse")
CHIRP = ChirpProfile(15.0, 3.0, 2.0, 40.0, 5.5, 0.5)
STAIRS = StaircaseProfile(15.0, 2.0, 3, 0.5, 4.0, 0.5)
ALL = [StepProfile(15.0, -3.0, 0.2, 1.0), TRIANGLE, MULTISINE, CHIRP, STAIRS]


@pytest.mark.parametrize("profile", ALL, ids=lambda profile: profile.kind)
@given(rate=st.floats(130.0, 5000.0))
def test_setpoint_starts_at_preload_and_stays_within_extremes(profile, rate):
    setpoint = profile.setpoint(rate)
    low, high = profile.extremes
    assert setpoint.shape == (profile.samples(rate),)
    assert setpoint[0] == 15.0
    assert low - 1e-12 <= setpoint.min() <= setpoint.max() <= high + 1e-12


def test_triangle_has_constant_rates_and_shrinking_cycles():
    setpoint = TRIANGLE.setpoint(RATE_HZ)
    rate = np.abs(np.diff(setpoint[100:])) * RATE_HZ  # from the start at 0.2 s
    for cycle, expected in enumerate((16.0, 8.0, 4.0)):
        within = rate[500 * cycle : 500 * (cycle + 1)]
        assert np.allclose(within, expected)
        assert setpoint[100 + 500 * cycle + 125] == pytest.approx(15.0 + 4.0 * 0.5**cycle)


def test_multisine_has_power_on_its_lines_only():
    profile = replace(MULTISINE, slope=1.5, corner_Hz=20.0)
    period = profile.setpoint(RATE_HZ)[250:1250]
    spectrum = np.abs(np.fft.rfft(period - 15.0)) / 500.0
    assert period.std() == pytest.approx(2.0)
    lines = np.flatnonzero(spectrum > 1e-9)
    np.testing.assert_array_equal(lines, profile.excited)
    weight = np.maximum(lines / 2.0 / 20.0, 1.0) ** 1.5
    assert spectrum[lines] / spectrum[lines[0]] == pytest.approx(weight)
    # One odd line out of each complete group of four is left out, no even one is excited.
    left_out = np.setdiff1d(np.arange(1, 121, 2), lines)
    np.testing.assert_array_equal(np.diff(left_out // 8), 1)
    assert len(set(left_out % 8)) == 4


def test_multisine_with_schroeder_phases_has_a_low_peak():
    profile = replace(MULTISINE, lines="all", last_line=200)
    low, high = profile.extremes
    assert (high - 15.0) / profile.rms_N < 2.0  # equal phases would reach sqrt(2 x 200) = 20
    fine = profile.setpoint(20_000.0)
    assert fine.max() - 15.0 > 0.97 * (high - 15.0) or 15.0 - fine.min() > 0.97 * (15.0 - low)


def test_chirp_sweeps_its_frequencies_evenly():
    setpoint = CHIRP.setpoint(10_000.0)[5000:] - 15.0
    # Half-cycles up to time s: (first s + (last - first) s^2/10) 2
    crossings = np.flatnonzero(np.diff(np.sign(setpoint)) != 0).size
    assert crossings == pytest.approx(2 * 5.0 * (2.0 + 40.0) / 2.0, abs=1)
    half = np.flatnonzero(np.diff(np.sign(setpoint[:25_000])) != 0).size
    assert half == pytest.approx(2 * (2.0 * 2.5 + 38.0 * 2.5**2 / 10.0), abs=1)


def test_staircase_rises_and_falls():
    levels = STAIRS.setpoint(RATE_HZ)[125::250]
    np.testing.assert_array_equal(levels, [15, 17, 19, 21, 19, 17, 15, 17])
    pulses = replace(STAIRS, stairs=1, step_N=-2.0).setpoint(RATE_HZ)[125::250]
    np.testing.assert_array_equal(pulses, [15, 13, 15, 13, 15, 13, 15, 13])


@given(st.integers(1, 400), st.integers(100, 4000))
def test_staircase_level_begins_at_nearest_sample(hold_samples, rate):
    profile = StaircaseProfile(
        0.0, 1.0, 2, hold_samples / rate, 0.1 + 8.5 * hold_samples / rate, 0.1
    )
    jumps = np.flatnonzero(np.diff(profile.setpoint(float(rate)))) + 1
    expected = np.ceil(0.1 * rate - 1e-6) + hold_samples * np.arange(jumps.size)
    np.testing.assert_array_equal(jumps, expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(TRIANGLE, amplitude_N=0.0), "amplitude_N is 0.0; it must be other than"),
        (lambda: replace(TRIANGLE, preload_N=math.nan), "preload_N is nan"),
        (lambda: replace(TRIANGLE, start_s=3.2), "must lie inside the trial"),
        (lambda: replace(TRIANGLE, shrink=1.1), "shrink is 1.1"),
        (lambda: replace(MULTISINE, rms_N=-1.0), "rms_N is -1.0; it must be above zero"),
        (lambda: replace(MULTISINE, first_line=0), "lines 0 to 120"),
        (lambda: replace(MULTISINE, last_line=10**9), "at most 2000"),
        (lambda: replace(MULTISINE, first_line=2, last_line=2), "no odd_sparse line"),
        (lambda: replace(MULTISINE, slope=1e3), "slope is 1000"),
        (lambda: MULTISINE.setpoint(120.0), "below half the sampling rate, 60 Hz"),
        (lambda: CHIRP.setpoint(80.0), "it reaches 40 Hz"),
        (lambda: replace(CHIRP, first_Hz=-1.0), "frequencies of zero or above"),
        (lambda: replace(STAIRS, stairs=0), "0 stairs"),
        (lambda: replace(STAIRS, hold_s=math.inf), "hold_s is inf"),
    ],
)
def test_profile_refuses_unusable_values(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()
