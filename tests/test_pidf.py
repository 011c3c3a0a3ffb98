"""The controller against python-control's continuous one, and its own properties."""

import math

import casadi as ca
import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.gains import Gains
from estune.core.pidf import (
    ControllerSettings,
    PidfState,
    bumpless,
    coefficients,
    state_at_rest,
    step,
    symbolic_coefficients,
)
from estune.errors import InvalidInput

UNLIMITED = (-math.inf, math.inf)
LIMITED = ControllerSettings(632.0, 5e-4, -20.0, 30.0)

magnitude = st.floats(1e-4, 1e4)
gain_values = st.builds(
    Gains, magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude
)
signal = st.floats(-1e3, 1e3)
states = st.builds(PidfState, signal, signal, signal)


def efforts(gains, settings, setpoint, measurement):
    """Effort at each sample, from rest at zero."""
    c, state = coefficients(settings, gains), state_at_rest(0.0, 0.0)
    effort = np.empty_like(setpoint)
    for k, (r, y) in enumerate(zip(setpoint, measurement, strict=True)):
        state, effort[k], _ = step(c, state, r, y)
    return effort


@pytest.mark.equation(32)
@pytest.mark.equation(33)
@pytest.mark.equation(34)
@pytest.mark.parametrize(
    "gains",
    [
        Gains(1.3, 50.0, 0.01, 0.02),
        Gains(0.4, 8.0, 0.0, 0.05),
        Gains(2.0, 0.0, 0.02, 0.01),
        Gains(0.7, 20.0, 0.03, 0.0),
    ],
    ids=["PIDF", "PI", "PD", "no setpoint filter"],
)
def test_sampled_controller_converges_to_the_continuous_one(gains):
    def greatest_difference(sampling_Hz):
        settings = ControllerSettings(sampling_Hz, 0.004, *UNLIMITED)
        t = np.arange(0.0, 0.5, 1.0 / sampling_Hz)
        setpoint = 1.0 - np.cos(14.0 * t)
        measurement = np.sin(9.0 * t) ** 2 + 0.2 * (1.0 - np.cos(40.0 * t))
        s = control.tf("s")
        F, C_r = 1.0 / (gains.setpoint_filter_s * s + 1.0), gains.P + gains.I / s
        C_y = C_r + gains.D * s / (settings.derivative_filter_s * s + 1.0)
        continuous = (
            control.forced_response(C_r * F, t, setpoint).outputs
            - control.forced_response(C_y, t, measurement).outputs
        )
        sampled = efforts(gains, settings, setpoint, measurement)
        return np.abs(sampled - continuous).max() / np.abs(continuous).max()

    coarse, fine = greatest_difference(1000.0), greatest_difference(8000.0)
    assert coarse < 0.1
    assert fine == pytest.approx(coarse / 8.0, rel=0.1)  # first-order discretisation


@given(
    gains=gain_values,
    state=states,
    signals=st.tuples(signal, signal),
    jump=st.floats(-10.0, 10.0),
    more_D=st.floats(0.0, 1e3),
)
def test_derivative_acts_on_the_measurement_only(gains, state, signals, jump, more_D):
    r, y = signals

    def change(gains, r_after, y_after):
        c = coefficients(ControllerSettings(632.0, 5e-4, *UNLIMITED), gains)
        return step(c, state, r_after, y_after)[1] - step(c, state, r, y)[1]

    steeper = Gains(gains.P, gains.I, gains.D + more_D, gains.setpoint_filter_s)
    span_s = 5e-4 + 1.0 / 632.0
    rounding = 1e-11 * (1.0 + 1e3 * (gains.P + (gains.D + more_D) / span_s))
    assert change(gains, r + jump, y) == pytest.approx(change(steeper, r + jump, y), abs=rounding)
    assert change(steeper, r, y + jump) - change(gains, r, y + jump) == pytest.approx(
        -more_D * jump / span_s, abs=rounding
    )


@given(gain_values, states, signal, signal)
def test_effort_is_limited_and_the_excess_returned(gains, state, r, y):
    free = ControllerSettings(LIMITED.sampling_Hz, LIMITED.derivative_filter_s, *UNLIMITED)
    _, unlimited, none = step(coefficients(free, gains), state, r, y)
    _, effort, excess = step(coefficients(LIMITED, gains), state, r, y)
    assert none == 0.0
    assert effort == np.clip(unlimited, -20.0, 30.0)
    assert excess == unlimited - effort


@pytest.mark.parametrize("gains", [Gains(1.0, 40.0, 0.0, 0.0), Gains(0.02, 900.0, 0.001, 0.0)])
def test_effort_leaves_saturation_as_soon_as_the_error_turns(gains):
    c, state = coefficients(LIMITED, gains), state_at_rest(0.0, 0.0)
    for _ in range(5000):
        state, effort, excess = step(c, state, 50.0, 0.0)
    assert effort == 30.0
    assert excess > 0.0
    # An integral wound up over 5000 samples of 50 N would need 250000 samples of -1 N to unwind.
    for _ in range(2):
        state, effort, excess = step(c, state, -1.0, 0.0)
    assert excess == 0.0
    assert effort < 30.0


@given(gain_values, gain_values, states, st.tuples(signal, signal), st.floats(-20.0, 30.0))
def test_bumpless_transfer_holds_the_effort(before, after, state, signals, held_effort):
    r, y = signals
    state, _, _ = step(coefficients(LIMITED, before), state, r, y)
    c = coefficients(LIMITED, after)
    state = bumpless(c, state, r, y, held_effort)
    _, effort, _ = step(c, state, r, y)
    terms = abs(held_effort) + after.P * 3e3 + after.D * 4e3 / (5e-4 + 1.0 / 632.0)
    assert effort == pytest.approx(held_effort, abs=1e-14 * terms)


@given(gain_values, signal, st.floats(-20.0, 30.0))
def test_settled_loop_stays_settled(gains, tension, effort):
    state = state_at_rest(tension, effort)
    following, given_effort, excess = step(coefficients(LIMITED, gains), state, tension, tension)
    rounding = 1e-15 * abs(tension) * (1.0 + gains.P + gains.I)
    assert given_effort == pytest.approx(effort, abs=rounding)
    assert excess == pytest.approx(0.0, abs=rounding)
    assert following == pytest.approx(state, abs=2.0 * rounding)


def test_floats_arrays_and_symbols_give_the_same_numbers():
    ca.GlobalOptions.setNumpyMode(1)
    rng = np.random.default_rng(7)
    n = 40
    gains = 10.0 ** rng.uniform([-2, 0, -4, -3], [1, 3, -1, -1], (n, 4))
    gains[::5, 1] = 0.0  # no integral action
    gains[::7, 3] = 0.0  # no setpoint filter
    values = rng.uniform(-30.0, 30.0, (n, 5))

    def one_step(gains, values):
        c = symbolic_coefficients(LIMITED, *gains)
        state, effort, excess = step(c, PidfState(*values[:3]), values[3], values[4])
        return [*state, effort, excess]

    batch = np.array(one_step(gains.T, values.T)).T
    g, v = ca.SX.sym("g", 4), ca.SX.sym("v", 5)
    symbolic = ca.Function(
        "one_step", [g, v], [ca.vertcat(*one_step(ca.vertsplit(g), ca.vertsplit(v)))]
    )
    for k in range(n):
        alone = one_step(gains[k].tolist(), values[k].tolist())
        np.testing.assert_allclose(batch[k], alone, rtol=1e-14, atol=1e-12)
        np.testing.assert_allclose(
            np.ravel(symbolic(gains[k], values[k])), alone, rtol=1e-14, atol=1e-12
        )


@given(magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude)
def test_parallel_and_standard_form_are_equivalent(P, I, D, setpoint_filter_s):
    gains = Gains(P, I, D, setpoint_filter_s)
    K, Ti, Td = gains.to_standard()
    assert K == P
    assert math.isinf(Ti) if I == 0.0 else Ti * I == pytest.approx(P)
    assert Td * P == pytest.approx(D)
    there_and_back = Gains.from_standard(K, Ti, Td, setpoint_filter_s)
    assert there_and_back.as_tuple() == pytest.approx(gains.as_tuple(), rel=1e-15)


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["P", "I", "D", "setpoint_filter_s"])
def test_invalid_gain_is_refused_by_name_and_value(name, bad):
    good = {"P": 1.0, "I": 2.0, "D": 0.1, "setpoint_filter_s": 0.01}
    with pytest.raises(InvalidInput, match=f"{name} is {bad}"):
        Gains(**{**good, name: bad})


def test_controller_without_proportional_gain_is_refused():
    with pytest.raises(InvalidInput, match=r"P is 0\.0; it must be finite and above zero"):
        Gains(0.0, 1.0, 0.0, 0.0)


@pytest.mark.parametrize("Ti", [0.0, -1.0, math.nan])
def test_invalid_integral_time_is_refused(Ti):
    with pytest.raises(InvalidInput, match=f"Ti is {Ti} s"):
        Gains.from_standard(1.0, Ti, 0.1)


@pytest.mark.parametrize(
    "settings",
    [
        (0.0, 1e-3, -1.0, 1.0),
        (math.nan, 1e-3, -1.0, 1.0),
        (math.inf, 1e-3, -1.0, 1.0),
        (632.0, -1e-3, -1.0, 1.0),
        (632.0, math.nan, -1.0, 1.0),
        (632.0, 1e-3, 1.0, -1.0),
        (632.0, 1e-3, 0.0, 0.0),
        (632.0, 1e-3, math.nan, 1.0),
    ],
)
def test_invalid_controller_settings_are_refused(settings):
    with pytest.raises(InvalidInput):
        ControllerSettings(*settings)
