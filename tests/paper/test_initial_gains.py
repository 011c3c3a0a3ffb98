import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.margins import controller_response
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput, UnsafeStart
from experiments.paper.initial_gains import (
    RULES,
    imc,
    pole_placement,
    propose,
    sensitivity_limited,
    ziegler_nichols,
)
from experiments.paper.second_order import GaugeMode, SecondOrder
from experiments.paper.sensitivity import NOISE_GAIN_MAX, SENSITIVITY_MAX, SETPOINT_PEAK_MAX
from plants.models.reel import reference_reel

SETTINGS = ControllerSettings(632.0, 0.002, -120.0, 120.0)
QUICK = ControllerSettings(1e5, 0.0, -1e9, 1e9)
"""Controller settings at a rate so high that the loop is continuous."""
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


def safe_gains(model, rule="sensitivity_limited"):
    """Gains of a rule, checked to be safe."""
    return propose(model, SETTINGS, rule).checked().gains


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


@settings(max_examples=5, deadline=None)
@given(model=MODELS)
@example(model=SecondOrder(1.0, 30.8359375, 0.25))  # a grid point of the mode beside zero
def test_sensitivity_limited_keeps_its_limits_for_any_plant(model):
    gains = sensitivity_limited(model, SETTINGS)
    sensitivity, setpoint, noise = peaks(model, gains)
    # The rule enforces them on its own grid; between its points they may be exceeded slightly.
    assert sensitivity < SENSITIVITY_MAX * 1.01
    assert setpoint < SETPOINT_PEAK_MAX * 1.01
    assert noise < NOISE_GAIN_MAX * 1.001
    assert propose(model, SETTINGS, "sensitivity_limited").margins.stable


@pytest.mark.parametrize("length", [0.5, 1.4])
def test_sensitivity_limited_has_the_largest_integral_gain_nearby(length):
    model = reel_model(length)
    best = sensitivity_limited(model, SETTINGS)
    draw = np.random.default_rng(0)
    for _ in range(300):
        P, D = best.P * draw.uniform(0.9, 1.1), best.D * draw.uniform(0.9, 1.1)
        I = best.I * 1.02
        sensitivity, setpoint, noise = peaks(model, Gains(P, I, D, P / I))
        assert (
            sensitivity > SENSITIVITY_MAX or setpoint > SETPOINT_PEAK_MAX or noise > NOISE_GAIN_MAX
        )


def test_sensitivity_limited_integral_gain_falls_with_length():
    designs = [safe_gains(reel_model(length)) for length in (0.5, 0.8, 1.1, 1.4)]
    assert all(0.7 < gains.P < 1.3 for gains in designs)
    assert all(long.I < short.I for short, long in pairwise(designs))


@settings(max_examples=30, deadline=None)
@given(damping=st.floats(0.05, 0.6), natural=st.floats(20.0, 60.0), pair=st.floats(0.3, 0.95))
def test_pole_placement_puts_the_poles_at_the_given_places(damping, natural, pair):
    model = SecondOrder(2.0, natural, damping, 0.002)
    pole_frequency = 1.6 * natural
    gains = pole_placement(model, SETTINGS, pole_frequency, pair)
    theta = 0.002 + 0.002 + 0.5 / 632.0  # dead time, derivative filter, half a hold
    for s in (
        -pole_frequency,
        pole_frequency * complex(-pair, math.sqrt(1 - pair**2)),
    ):
        G = 2.0 * natural**2 / (s**2 + 2 * damping * natural * s + natural**2)
        C = gains.P + gains.I / s + gains.D * s
        assert abs(1.0 + C * G * np.exp(-s * theta)) < 1e-6


def test_pole_placement_without_dead_time_is_the_textbook_polynomial():
    k, w, zeta, pole_frequency, pair = 1.5, 50.0, 0.1, 80.0, 0.7
    gains = pole_placement(SecondOrder(k, w, zeta), QUICK, pole_frequency, pair)
    poles = np.roots(
        [1.0, 2 * zeta * w + k * w**2 * gains.D, w**2 * (1 + k * gains.P), k * w**2 * gains.I]
    )
    pole = pole_frequency * complex(-pair, math.sqrt(1 - pair**2))
    expected = np.array([-pole_frequency, pole, pole.conjugate()])
    assert np.sort_complex(poles) == pytest.approx(np.sort_complex(expected), rel=2e-3)


def test_imc_makes_the_loop_an_integrator():
    model = SecondOrder(0.8, 45.0, 0.2, 0.003)
    gains = imc(model, QUICK, closed_loop_s=0.02)
    s = 1j * np.geomspace(1.0, 300.0, 40)
    G = 0.8 * 45.0**2 / (s**2 + 2 * 0.2 * 45.0 * s + 45.0**2)
    loop = (gains.P + gains.I / s + gains.D * s) * G
    assert loop == pytest.approx(1.0 / (s * (0.02 + 0.003)), rel=1e-3)


def test_ziegler_nichols_uses_the_ultimate_gain_and_period():
    model = SecondOrder(1.2, 48.0, 0.3, 5.0 / (4 * 632.0))
    gains = ziegler_nichols(model, SETTINGS)
    ultimate, period_s = gains.P / 0.6, 2.0 * gains.P / gains.I
    assert math.isclose(gains.D, gains.P * period_s / 8.0, rel_tol=1e-6)
    swings = {}
    for factor in (0.99, 1.01):
        y = simulated_loop(model, Gains(ultimate * factor, 0.0, 0.0, 0.0), 1500)
        swings[factor] = np.abs(y[-300:]).max() / np.abs(y[300:600]).max()
    assert swings[0.99] < 1.0 < swings[1.01]
    spectrum = np.abs(np.fft.rfft(y * np.hanning(y.size)))
    assert spectrum.argmax() * 632.0 / 1500 == pytest.approx(1.0 / period_s, rel=0.02)


def test_proposal_margins_agree_with_the_simulated_loop():
    for rule in RULES:
        proposal = propose(reel_model(0.8), SETTINGS, rule)
        y = simulated_loop(reel_model(0.8), proposal.gains, 3000)
        assert proposal.margins.stable == bool(np.abs(y[-500:]).max() < 0.1 * np.abs(y).max())


def test_unsafe_gains_and_invalid_models_are_refused():
    with pytest.raises(UnsafeStart, match=r"phase margin \d+ degrees.*use sensitivity_limited"):
        safe_gains(reel_model(0.8), "ziegler_nichols")
    with pytest.raises(InvalidInput, match="more effort lowers the output"):
        safe_gains(SecondOrder(-1.0, 50.0, 0.1))
    with pytest.raises(InvalidInput, match="there is no rule"):
        safe_gains(reel_model(0.8), "shen_chiang")
    with pytest.raises(InvalidInput, match="not all positive"):
        pole_placement(reel_model(0.8), SETTINGS, 5.0)
    with pytest.raises(InvalidInput, match="damping ratio is nan"):
        SecondOrder(1.0, 50.0, math.nan)
