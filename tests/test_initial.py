import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.margins import controller_response, loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.second_order import GaugeMode, SecondOrder
from estune.core.sensitivity import (
    NOISE_GAIN_MAX,
    SENSITIVITY_MAX,
    SETPOINT_PEAK_MAX,
    largest_integral_gain,
)
from estune.errors import InvalidInput
from plants.models.reel import reference_reel

SETTINGS = ControllerSettings(632.0, 0.002, -120.0, 120.0)
GAUGE = GaugeMode(2 * math.pi * 290.0, 0.03)

MODELS = st.builds(
    SecondOrder,
    gain=st.floats(0.2, 5.0),
    natural_frequency_rad_s=st.floats(20.0, 120.0),
    damping=st.floats(0.03, 0.9),
    dead_time_s=st.floats(0.0, 0.006),
    gauge=st.none() | st.just(GAUGE),
)


def reel_model(length):
    reel = reference_reel(length, 15.0)
    w = reel.natural_frequency_rad_s
    zeta = (0.010 + 0.015 * length) / (2.0 * 2.0e-3 * w)
    return SecondOrder(1.0, w, zeta, reel.dead_time_s, GAUGE)


def sampled(model):
    A, B, C, E = model.state_space()
    sample_s = 1.0 / SETTINGS.sampling_Hz
    return sample_plant(A, B, C, E, dead_time_s=model.dead_time_s, sample_s=sample_s)


def sensitivity_limited(model):
    return largest_integral_gain(sampled(model), SETTINGS)


def peaks(model, gains):
    """Peak sensitivity and setpoint response on an independent grid, and C_y at its end."""
    f = np.unique(np.concatenate([np.geomspace(0.01, 315.999, 4000), np.linspace(280, 300, 400)]))
    theta = 2 * np.pi * f / SETTINGS.sampling_Hz
    C = controller_response(gains, SETTINGS, theta)
    G = model.sampled_response(f, SETTINGS.sampling_Hz)
    back = np.abs(1.0 + C * G)
    # The filter P/I takes the zero out of C_r, so that I/(z - 1) h is left.
    T = gains.I / SETTINGS.sampling_Hz * np.abs(G / np.expm1(1j * theta)) / back
    return 1.0 / back.min(), T.max(), abs(C[-1])


def simulated_loop(model, gains, samples, sampling=SETTINGS):
    """Impulse response of the loop, by stepping controller and plant on a fine clock."""
    A, B, C, _ = model.state_space()
    fine = 4
    Phi, Gamma, *_ = cont2discrete(
        (A, B[:, None], C[None], np.zeros((1, 1))), 1.0 / (sampling.sampling_Hz * fine), "zoh"
    )
    late = [0.0] * round(model.dead_time_s * sampling.sampling_Hz * fine)
    c, state = pidf.coefficients(sampling, gains), pidf.state_at_rest(0.0, 0.0)
    x, outputs = np.zeros(len(A)), []
    for k in range(samples):
        y = float(C @ x)
        outputs.append(y)
        state, u, _ = pidf.step(c, state, 0.0, y)
        u += float(k == 0)
        for _ in range(fine):
            late.append(u)
            x = Phi @ x + Gamma[:, 0] * late.pop(0)
    return np.array(outputs)


@settings(max_examples=10, deadline=None)
@given(model=MODELS)
@example(model=SecondOrder(1.0, 30.8359375, 0.25))  # a grid point of the mode beside zero
def test_sensitivity_limited_keeps_its_limits_for_any_plant(model):
    gains = sensitivity_limited(model)
    sensitivity, setpoint, noise = peaks(model, gains)
    # The rule enforces them on its own grid; between its points they may be exceeded slightly.
    assert sensitivity < SENSITIVITY_MAX * 1.01
    assert setpoint < SETPOINT_PEAK_MAX * 1.01
    assert noise < NOISE_GAIN_MAX * 1.001
    assert loop_margins(sampled(model), gains, SETTINGS).stable


@pytest.mark.parametrize("length", [0.5, 1.4])
def test_sensitivity_limited_has_the_largest_integral_gain_nearby(length):
    model = reel_model(length)
    best = sensitivity_limited(model)
    draw = np.random.default_rng(0)
    for _ in range(300):
        P, D = best.P * draw.uniform(0.9, 1.1), best.D * draw.uniform(0.9, 1.1)
        I = best.I * 1.02
        sensitivity, setpoint, noise = peaks(model, Gains(P, I, D, P / I))
        assert (
            sensitivity > SENSITIVITY_MAX or setpoint > SETPOINT_PEAK_MAX or noise > NOISE_GAIN_MAX
        )


def test_sensitivity_limited_integral_gain_falls_with_length():
    designs = [sensitivity_limited(reel_model(length)) for length in (0.5, 0.8, 1.1, 1.4)]
    assert all(0.7 < gains.P < 1.3 for gains in designs)
    assert all(long.I < short.I for short, long in pairwise(designs))


@pytest.mark.parametrize("factor", [1.0, 8.0])
def test_margins_agree_with_the_simulated_loop(factor):
    model = reel_model(0.8)
    best = sensitivity_limited(model)
    gains = Gains(factor * best.P, factor * best.I, factor * best.D, best.setpoint_filter_s)
    y = simulated_loop(model, gains, 3000)
    stable = loop_margins(sampled(model), gains, SETTINGS).stable
    assert stable is (factor == 1.0)
    assert stable == bool(np.abs(y[-500:]).max() < 0.1 * np.abs(y).max())


def test_invalid_models_are_refused():
    with pytest.raises(InvalidInput, match="turn the sign of the input"):
        sensitivity_limited(SecondOrder(-1.0, 50.0, 0.1))
    with pytest.raises(InvalidInput, match="damping ratio is nan"):
        SecondOrder(1.0, 50.0, math.nan)
