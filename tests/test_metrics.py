"""Step metrics against closed forms and python-control, and on bad data."""

import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.metrics import NO_METRICS, load_metrics, step_metrics

SAMPLING_Hz = 2000.0
TIME_s = np.arange(0.0, 2.0, 1.0 / SAMPLING_Hz)
STEP_s = 0.25
AFTER_s = np.maximum(TIME_s - STEP_s, 0.0)


def second_order(damping, omega=40.0):
    """Unit step response of an underdamped second-order system."""
    ringing = omega * math.sqrt(1.0 - damping**2)
    lag = np.exp(-damping * omega * AFTER_s)
    turn = np.cos(ringing * AFTER_s) + damping * omega / ringing * np.sin(ringing * AFTER_s)
    return 1.0 - lag * turn


def measure(response, initial=0.0, final=1.0, **rest):
    values = initial + (final - initial) * response
    return step_metrics(TIME_s, values, step_time_s=STEP_s, initial=initial, final=final, **rest)


@pytest.mark.parametrize("lag_s", [0.02, 0.1, 0.3])
def test_first_order_response_has_closed_form_metrics(lag_s):
    metrics = measure(1.0 - np.exp(-AFTER_s / lag_s), band=0.02)
    assert metrics.rise_time_s == pytest.approx(lag_s * math.log(9.0), rel=1e-4)
    assert metrics.settling_time_s == pytest.approx(lag_s * math.log(50.0), rel=1e-4)
    assert metrics.overshoot == metrics.undershoot == 0.0
    assert metrics.iae == pytest.approx(lag_s, rel=4e-3)  # of a first-order lag, its time constant


def test_response_to_a_load_has_the_peak_and_recovery_time_of_its_closed_form():
    lag_s, step, load = 0.05, int(STEP_s * SAMPLING_Hz), int(1.0 * SAMPLING_Hz)
    after = np.maximum(TIME_s - 1.0, 0.0) / lag_s
    response = np.where(TIME_s < STEP_s, 5.0, 7.0) + 3.0 * after * np.exp(1.0 - after)
    metrics = load_metrics(TIME_s, response, step=step, load=load, initial=5.0, final=7.0)
    assert metrics.peak == pytest.approx(3.0, rel=1e-4)
    shares = 1.5 * after * np.exp(1.0 - after)
    assert metrics.recovery_time_s == pytest.approx(
        TIME_s[np.flatnonzero(shares > 0.02)[-1]] - 1.0, abs=2.0 / SAMPLING_Hz
    )


@pytest.mark.parametrize("damping", [0.1, 0.4, 0.7])
def test_second_order_response_has_closed_form_overshoot(damping):
    metrics = measure(second_order(damping))
    expected = math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert metrics.overshoot == pytest.approx(expected, rel=1e-3)
    assert metrics.steady_state_error == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    "system",
    [
        control.tf([1.0], [0.1, 1.0]),
        control.tf([1600.0], [1.0, 16.0, 1600.0]),
        control.tf([1.0], [0.02, 0.35, 1.0]),
        control.tf([-0.03, 1.0], [0.002, 0.12, 1.0]),  # undershoots first
    ],
    ids=["first order", "ringing", "overdamped", "non-minimum phase"],
)
def test_metrics_agree_with_python_control_on_ideal_steps(system):
    t = np.arange(0.0, 3.0, 1.0 / SAMPLING_Hz)
    response = control.step_response(system, t).outputs
    metrics = step_metrics(t, response, step_time_s=0.0, initial=0.0, final=1.0)
    info = control.step_info(response, t, final_output=1.0)
    assert metrics.rise_time_s == pytest.approx(info["RiseTime"], abs=1.01 / SAMPLING_Hz)
    assert metrics.settling_time_s == pytest.approx(info["SettlingTime"], abs=1.01 / SAMPLING_Hz)
    assert metrics.overshoot == pytest.approx(info["Overshoot"] / 100.0, abs=1e-12)
    assert metrics.undershoot == pytest.approx(info["Undershoot"] / 100.0, abs=1e-12)


@given(
    damping=st.floats(0.05, 0.95),
    initial=st.floats(-100.0, 100.0),
    span=st.floats(0.1, 100.0) | st.floats(-100.0, -0.1),
)
def test_metrics_are_independent_of_offset_and_direction(damping, initial, span):
    response = second_order(damping)
    metrics, plain = measure(response, initial, initial + span), measure(response)
    assert metrics[:3] == pytest.approx(plain[:3], abs=1e-6, nan_ok=True)
    assert metrics.steady_state_error == pytest.approx(span * plain.steady_state_error, abs=1e-9)
    assert metrics.iae == pytest.approx(abs(span) * plain.iae, abs=1e-9)


def test_step_from_10_to_11_has_a_rise_time():
    response = 10.0 + (1.0 - np.exp(-AFTER_s / 0.1))
    assert control.step_info(response, TIME_s, final_output=11.0)["RiseTime"] == 0.0
    metrics = step_metrics(TIME_s, response, step_time_s=STEP_s, initial=10.0, final=11.0)
    assert metrics.rise_time_s == pytest.approx(0.1 * math.log(9.0), rel=1e-4)


def test_step_to_zero_has_an_overshoot():
    response = 5.0 * (1.0 - second_order(0.4))
    metrics = step_metrics(TIME_s, response, step_time_s=STEP_s, initial=5.0, final=0.0)
    expected = math.exp(-math.pi * 0.4 / math.sqrt(1.0 - 0.4**2))
    assert metrics.overshoot == pytest.approx(expected, rel=1e-3)
    info = control.step_info(response, TIME_s, final_output=0.0)
    assert info["SteadyStateValue"] == response[-1] != 0.0
    assert info["Overshoot"] > 1e5


def test_response_below_90_percent_has_no_rise_time():
    response = 0.8 * (1.0 - np.exp(-AFTER_s / 0.1))
    with pytest.raises(IndexError):
        control.step_info(response, TIME_s, final_output=1.0)
    metrics = measure(response)
    assert math.isnan(metrics.rise_time_s)
    assert math.isnan(metrics.settling_time_s)
    assert metrics.overshoot == 0.0
    assert metrics.steady_state_error == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize("omega", np.linspace(35.0, 45.0, 7))  # any final phase
def test_response_oscillating_at_the_end_is_not_settled(omega):
    metrics = measure(second_order(0.005, omega))
    assert math.isnan(metrics.settling_time_s)
    assert math.isfinite(metrics.rise_time_s)


def test_settling_band_is_a_fraction_of_the_step():
    lag_s = 0.1
    wide = measure(1.0 - np.exp(-AFTER_s / lag_s), initial=10.0, final=11.0, band=0.1)
    assert wide.settling_time_s == pytest.approx(lag_s * math.log(10.0), rel=1e-4)


def noisy(response, share, seed=11):
    """Response with noise; `share` is its standard deviation over the step."""
    return response + share * np.random.default_rng(seed).standard_normal(response.size)


def test_noise_changes_metrics_by_at_most_four_deviations():
    response = 1.0 - np.exp(-np.maximum(AFTER_s - 0.3, 0.0) / 0.1)  # long flat, then the rise
    share = 0.004  # 0.04 N of gauge noise on a step of 10 N
    metrics, clean = measure(noisy(response, share)), measure(response)
    inner_rise = 0.1 * math.log((0.9 - 4.0 * share) / (0.1 + 4.0 * share))
    assert inner_rise < metrics.rise_time_s <= clean.rise_time_s + 1.0 / SAMPLING_Hz
    tight = measure(response, band=0.02 - 4.0 * share)
    assert clean.settling_time_s <= metrics.settling_time_s < tight.settling_time_s
    assert metrics.overshoot == pytest.approx(0.0, abs=5.0 * share)
    assert metrics.steady_state_error == pytest.approx(0.0, abs=share)


@pytest.mark.parametrize(
    "response",
    [
        second_order(0.4),
        1.3 * AFTER_s / AFTER_s[-1],  # highest at its end
        np.where(TIME_s < STEP_s, 0.0, 1.0 + 0.4 * np.exp(-AFTER_s / 0.2)),  # and at the step
    ],
    ids=["peak", "at the end", "at the step"],
)
def test_noise_raises_an_overshoot_by_less_than_its_deviation(response):
    """The largest sample is higher by about three of them."""
    share = 0.004
    true = measure(response).overshoot
    found = [measure(noisy(response, share, seed)).overshoot for seed in range(20)]
    assert np.mean(found) == pytest.approx(true, abs=0.5 * share)
    assert np.abs(np.subtract(found, true)).max() < 2.0 * share


def test_noise_makes_an_overshoot_of_at_most_twice_its_deviation_where_there_is_none():
    share, response = 0.004, 1.0 - np.exp(-AFTER_s / 0.1)
    found = [measure(noisy(response, share, seed)).overshoot for seed in range(20)]
    assert np.mean(found) < 2.0 * share


def test_noise_before_the_step_allows_few_samples_after_it():
    few = slice(0, int(STEP_s * SAMPLING_Hz) + 3)
    response = noisy(1.0 - np.exp(-AFTER_s / 1e-4), 0.002)[few]
    metrics = step_metrics(TIME_s[few], response, step_time_s=STEP_s, initial=0.0, final=1.0)
    assert metrics.overshoot == pytest.approx(0.0, abs=0.01)


def test_deviation_at_rest_before_the_step_is_no_noise():
    response = 1.0 - np.exp(-AFTER_s / 0.1)
    assert measure(response + np.where(TIME_s < STEP_s, 0.05, 0.0)) == measure(response)


def test_response_that_is_half_way_at_once_rises_from_the_step_on():
    metrics = measure(np.where(TIME_s < STEP_s, 0.0, 1.0 - 0.5 * np.exp(-AFTER_s / 0.1)))
    assert metrics.rise_time_s == pytest.approx(0.1 * math.log(5.0), rel=1e-4)


@pytest.mark.parametrize(("down", "name"), [(False, "overshoot"), (True, "undershoot")])
def test_peak_of_few_samples_is_as_high_as_its_largest(down, name):
    response = 1.0 - np.exp(-AFTER_s / 0.01)
    response[1500:1503] += np.array([0.2, 0.4, 0.2]) if not down else [-1.2, -1.4, -1.2]
    assert getattr(measure(noisy(response, 0.002)), name) == pytest.approx(0.4, abs=0.008)


def test_noise_above_the_settling_band_widens_it():
    response = 1.0 - np.exp(-AFTER_s / 0.1)
    share = 0.01  # two deviations are the whole band of 2 %: one sample in twenty is outside
    metrics = measure(noisy(response, share))
    assert metrics.settling_time_s >= measure(response, band=4.0 * share).settling_time_s
    assert metrics.settling_time_s < measure(response, band=share / 2.0).settling_time_s


def test_oscillation_before_the_step_is_not_noise():
    oscillating = 0.1 * np.sin(300.0 * TIME_s)
    metrics = measure(1.0 - np.exp(-AFTER_s / 0.02) + oscillating)
    assert math.isnan(metrics.settling_time_s)


def test_oscillation_before_the_step_does_not_end_a_recovery():
    swinging = 0.1 * np.sin(300.0 * TIME_s)
    step, load = int(STEP_s * SAMPLING_Hz), int(1.0 * SAMPLING_Hz)
    response = np.where(TIME_s < STEP_s, 0.0, 1.0) + swinging
    metrics = load_metrics(TIME_s, response, step=step, load=load, initial=0.0, final=1.0)
    assert math.isnan(metrics.recovery_time_s)


def test_steady_state_error_is_the_mean_over_the_last_tenth():
    response = np.linspace(0.0, 3.0, TIME_s.size)
    after = int((TIME_s >= STEP_s).sum())
    metrics = measure(response, initial=2.0, final=7.0)
    tail = 2.0 + 5.0 * response[-(after // 10) :]
    assert metrics.steady_state_error == pytest.approx(7.0 - tail.mean())


def test_immediate_response_has_zero_times():
    metrics = measure(np.where(TIME_s < STEP_s, 0.0, 1.0))
    assert metrics == (0.0,) * 6


def with_value(value, index=700):
    response = second_order(0.4)
    response[index] = value
    return response


@pytest.mark.parametrize(
    ("time", "values", "initial", "final"),
    [
        (TIME_s, with_value(math.nan), 0.0, 1.0),
        (TIME_s, with_value(math.inf), 0.0, 1.0),
        (TIME_s, np.full(TIME_s.size, math.nan), 0.0, 1.0),
        (TIME_s, second_order(0.4), 1.0, 1.0),
        (TIME_s, second_order(0.4), math.nan, 1.0),
        (TIME_s, second_order(0.4), 0.0, math.inf),
        (TIME_s, second_order(0.4)[:-1], 0.0, 1.0),
        (TIME_s[::-1], second_order(0.4), 0.0, 1.0),
        (np.full(TIME_s.size, math.nan), second_order(0.4), 0.0, 1.0),
        (TIME_s[:400], second_order(0.4)[:400], 0.0, 1.0),
        ([STEP_s], [1.0], 0.0, 1.0),
        ([], [], 0.0, 1.0),
    ],
    ids=[
        *("NaN sample", "infinite sample", "all NaN", "no step", "NaN level", "infinite level"),
        *("lengths differ", "time backwards", "NaN times", "before the step", "one sample"),
        "empty",
    ],
)
def test_bad_data_give_nan_metrics(time, values, initial, final):
    metrics = step_metrics(time, values, step_time_s=STEP_s, initial=initial, final=final)
    assert list(map(math.isnan, metrics)) == [True] * len(NO_METRICS)


@pytest.mark.parametrize("when_s", [-math.inf, math.inf, math.nan])
def test_step_at_no_time_gives_nan_metrics(when_s):
    metrics = step_metrics(TIME_s, second_order(0.4), step_time_s=when_s, initial=0.0, final=1.0)
    assert list(map(math.isnan, metrics)) == [True] * len(NO_METRICS)


@given(st.lists(st.floats(), max_size=12), st.floats(), st.floats(), st.floats(), st.floats(0, 2))
def test_metrics_never_raise(values, step_time, initial, final, band):
    metrics = step_metrics(
        np.arange(len(values)),
        values,
        step_time_s=step_time,
        initial=initial,
        final=final,
        band=band,
    )
    assert metrics.overshoot >= 0.0 or math.isnan(metrics.overshoot)
