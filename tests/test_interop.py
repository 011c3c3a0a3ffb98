"""Exchange of controllers, plants and loops with python-control."""

import math

import control
import numpy as np
import pytest

from estune.core.gain_forms import backed_off, gain_forms
from estune.core.gains import Gains
from estune.core.margins import sample_plant
from estune.core.pidf import ControllerSettings, coefficients, state_at_rest, step
from estune.errors import InvalidInput
from estune.interop import (
    closed_loop,
    linear_model,
    margins,
    sampled_controller,
)

s = control.tf("s")


def settings(sampling_Hz, derivative_filter_s):
    return ControllerSettings(sampling_Hz, derivative_filter_s, -math.inf, math.inf)


# --- the plant -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "system",
    [
        1 / (1 + 10 * s) ** 8,
        1e-3 / (1 + 2000 * s) ** 5,
        (1 - 5 * s) / ((1 + 10 * s) * (1 + 20 * s)),
        3e12 * (s + 2) / ((s**2 + 80 * s + 4e4) * (s**2 + 100 * s + 3.3e6) * (s + 900)),
        (2 * s + 1) / (s + 3),
        control.tf([5.0], [1.0]),
        control.ss([[0.0, 1.0], [-4.0, -0.4]], [[0.0], [1.0]], [[1.0, 0.2]], [[0.1]]),
    ],
    ids=[
        "eight lags",
        "slow lags",
        "non-minimum phase",
        "fast modes",
        "feed-through",
        "gain",
        "state space",
    ],
)
def test_linear_model_has_the_systems_frequency_response(system):
    model = linear_model(system, 0.25)
    A, B, C = (np.array(part) for part in (model.A, model.B, model.C))
    for omega in np.geomspace(1e-3, 1e4, 15):
        response = model.E
        if B.size:
            response = response + C @ np.linalg.solve(1j * omega * np.eye(B.size) - A, B)
        assert response == pytest.approx(system(1j * omega), rel=1e-9)
    assert model.dead_time_s == 0.25


@pytest.mark.parametrize(
    ("system", "dead_time_s", "why"),
    [
        (s**2 / (s + 1), 0.0, "more zeros than poles; add the pole"),
        (control.tf([1.0], [1.0, 1.0], 0.1), 0.0, "discrete, sampled every 0.1 s"),
        (control.ss(-np.eye(2), np.eye(2), np.eye(2), 0.0), 0.0, "2 inputs and 2 outputs; choose"),
        (control.frd([1.0, 0.5], [1.0, 2.0]), 0.0, "FrequencyResponseData; .* fit"),
        (control.ss([[math.inf]], [[1.0]], [[1.0]], [[0.0]]), 0.0, "not finite"),
        (control.tf([math.nan], [1.0, math.inf]), 0.0, "not finite"),
        ("1/(s+1)", 0.0, "is a str"),
        (1 / (s + 1), -1.0, "dead time is -1.0 s"),
        (1 / (s + 1), math.nan, "dead time is nan s"),
        (1 / (s + 1), math.inf, "dead time is inf s"),
    ],
)
def test_linear_model_refuses_other_systems_with_remedy(system, dead_time_s, why):
    with pytest.raises(InvalidInput, match=why):
        linear_model(system, dead_time_s)


def matrices(model):
    n = len(model.B)
    A = np.reshape(np.asarray(model.A, dtype=float), (n, n))
    return A, np.array(model.B, dtype=float), np.array(model.C, dtype=float), model.E


def sampled_model_of(model, sampling_Hz):
    return sample_plant(
        *matrices(model), dead_time_s=model.dead_time_s, sample_s=1.0 / sampling_Hz
    )


@pytest.mark.parametrize("dead_time_samples", [0.0, 0.3, 1.0, 2.75])
def test_sampled_plant_is_the_plant_with_zero_order_hold(dead_time_samples):
    """The reference is the closed-form step response with an explicit delay."""
    sampling_Hz, dead_time_s = 50.0, dead_time_samples / 50.0
    plant = sampled_model_of(linear_model(1 / (0.1 * s + 1), dead_time_s), sampling_Hz)
    commands = np.random.default_rng(2).normal(size=40)
    moves = np.diff(commands, prepend=0.0)

    state, past, simulated = np.zeros(1), np.zeros(plant.delay + 1), []
    for command in commands:
        simulated.append(float(plant.C @ state) + plant.E * past[-1])
        line = np.concatenate([[command], past])
        state = plant.Phi @ state + plant.now * line[-2] + plant.before * line[-1]
        past = line[:-1]

    t = np.arange(40) / sampling_Hz
    since = t[:, None] - t[None, :] - dead_time_s
    expected = (np.where(since > 0.0, 1.0 - np.exp(-since / 0.1), 0.0) * moves).sum(axis=1)
    np.testing.assert_allclose(simulated, expected, atol=1e-12)


# --- what is handed out -----------------------------------------------------------------------

GAINS = Gains(P=0.8, I=20.0, D=0.004, setpoint_filter_s=0.01)


def test_sampled_controller_runs_as_the_difference_equation():
    about = settings(632.0, 0.002)
    c, state = coefficients(about, GAINS), state_at_rest(0.0, 0.0)
    signals = np.random.default_rng(0).standard_normal((2, 50))
    efforts = []
    for r, y in signals.T:
        state, effort, _ = step(c, state, r, y)
        efforts.append(effort)
    system = sampled_controller(GAINS, about)
    response = control.forced_response(system, np.arange(50) / 632.0, signals)
    np.testing.assert_allclose(response.outputs.squeeze(), efforts, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dead_samples", [0.0, 0.4, 1.0, 2.3])
def test_closed_loop_is_that_of_a_sample_by_sample_simulation(dead_samples):
    rate, n, fine = 100.0, 60, 50
    about, model = settings(rate, 0.02), linear_model(3.0 / (s + 2.0), dead_samples / rate)
    c, state = coefficients(about, GAINS), state_at_rest(0.0, 0.0)
    x, efforts, measured = 0.0, np.zeros(n), np.zeros(n)
    for k in range(n):
        measured[k] = x
        state, efforts[k], _ = step(c, state, 1.0, x)
        for j in range(
            fine
        ):  # exact between changes of a command that is held, late by the dead time
            at = k + j / fine - dead_samples + 1e-9
            u = efforts[int(at)] if at >= 0.0 else 0.0
            pole = math.exp(-2.0 / (rate * fine))
            x = pole * x + (1.0 - pole) * 1.5 * u
    loop = closed_loop(model, GAINS, about)
    setpoint = np.vstack([np.ones(n), np.zeros(n)])
    response = control.forced_response(loop, np.arange(n) / rate, setpoint)
    np.testing.assert_allclose(response.outputs[0], measured, atol=1e-9)
    np.testing.assert_allclose(response.outputs[1], efforts, atol=1e-9)


def test_forms_are_the_same_controller():
    forms = {f.name: f.values for f in gain_forms(GAINS, settings(632.0, 0.002))}
    one, two = forms["standard"], forms["series"]
    parallel = GAINS.P + GAINS.I / s + GAINS.D * s
    for other in (
        one["Kp"] * (1.0 + 1.0 / (one["Ti_s"] * s) + one["Td_s"] * s),
        two["Kp"] * (1.0 + 1.0 / (two["Ti_s"] * s)) * (1.0 + two["Td_s"] * s),
    ):
        assert other(5.0j) == pytest.approx(parallel(5.0j), rel=1e-12)
    assert forms["per_sample"]["I_k"] * 632.0 == pytest.approx(GAINS.I)
    oscillating = Gains(P=0.8, I=200.0, D=0.004, setpoint_filter_s=0.0)
    assert "series" not in {f.name for f in gain_forms(oscillating, settings(632.0, 0.002))}


def test_backed_off_gains_have_the_larger_gain_margin():
    model, about = linear_model(1.0 / (0.1 * s + 1.0), 0.01), settings(632.0, 0.002)
    optimum, backed = (margins(model, g, about) for g in (GAINS, backed_off(GAINS, 0.25)))
    assert backed.gain_margin == pytest.approx(optimum.gain_margin / 0.75, rel=1e-6)
    with pytest.raises(InvalidInput, match="from 0 to 1"):
        backed_off(GAINS, 1.2)
