"""Linear systems and Python functions as plants."""

import control
import numpy as np
import pytest

import estune
import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput, PlantError, UnsafeStart
from estune.trial.profiles import StepProfile
from plants.effects import DeadTime, GainError


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: plants.reference_reel(cable_length_m=0.0), "cable_length_m"),
        (lambda: plants.reference_reel(tension_N=float("nan")), "tension_N"),
        (lambda: plants.reference_reel(tension_N=50.0), "5 to 40 N"),
        (lambda: plants.reference_reel(current_limit_A=1.0), "hold no more than"),
        (lambda: plants.reference_reel(colour=3), "no colour"),
        (lambda: plants.CoulombFriction(torque_Nm=-1.0), "torque_Nm"),
        (lambda: plants.CoulombFriction(torque_Nm=float("nan")), "torque_Nm"),
    ],
)
def test_reel_rejects_values_out_of_range(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


SYSTEMS = {
    "lag": control.tf([2.0], [0.5, 1.0]),
    "resonance": control.tf([3.0], [0.01, 0.02, 1.0]),
    "eighth order": control.tf([1.0], np.poly([-10.0] * 8) / 10.0**8),
    "integrator": control.tf([1.0], [1.0, 2.0, 0.0]),
    "unstable": control.tf([2.0], [1.0, -1.0]),
    "feed-through": control.tf([0.1, 1.0], [0.5, 1.0]),
    "gain": control.tf([0.5], [1.0]),
    "state space": control.ss([[-1.0, 4.0], [-4.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0.0),
}


@pytest.mark.parametrize("dead_samples", [0.0, 0.25, 3.0, 40.5])
@pytest.mark.parametrize("name", SYSTEMS)
def test_linear_trial_agrees_with_python_control(name, dead_samples):
    rate, fine = 50.0, 4
    plant = plants.linear_plant(SYSTEMS[name], dead_samples / rate, rate)
    gains = Gains(0.4, 0.3, 0.01, 0.1)
    trial = plants.simulate(plant, gains, StepProfile(0.0, 1.0, 0.1, 4.0))
    # Plant: its effort through python-control on a grid that contains the dead time.
    n = len(trial.time_s)
    late = np.concatenate([np.zeros(round(dead_samples * fine)), np.repeat(trial.effort_N, fine)])
    states = control.ss(SYSTEMS[name])
    sampled = (
        states.sample(1.0 / (rate * fine)) if states.nstates else control.ss(states, dt=0.005)
    )
    before = late[: n * fine]
    x = (
        control.forced_response(
            control.ss(sampled.A, sampled.B, np.eye(sampled.nstates), 0.0, sampled.dt), U=before
        ).outputs
        if sampled.nstates
        else np.zeros((1, n * fine))
    )
    in_force = np.concatenate([[0.0], before[:-1]])
    C = sampled.C if sampled.nstates else np.zeros((1, 1))
    expected = (C @ np.atleast_2d(x))[0] + sampled.D[0, 0] * in_force
    assert trial.tension_N == pytest.approx(expected[::fine], abs=1e-9)
    # Controller: its measurement through the controller of the rig.
    c, state = pidf.coefficients(plant.controller, gains), pidf.state_at_rest(0.0, 0.0)
    for r, y, u in zip(trial.setpoint_N, trial.tension_N, trial.effort_N, strict=True):
        state, effort, _ = pidf.step(c, state, r, y)
        assert u == pytest.approx(effort, abs=1e-12)


def test_linear_trial_starts_settled_at_its_preload():
    for name in ("lag", "resonance", "integrator", "feed-through", "state space"):
        plant = plants.linear_plant(SYSTEMS[name], 0.1, 50.0)
        trial = plants.simulate(plant, Gains(0.4, 0.3, 0.0, 0.1), StepProfile(7.0, 1.0, 1.0, 2.0))
        assert trial.tension_N[:50] == pytest.approx(7.0)


def test_linear_plant_without_gain_at_rest_accepts_only_zero_preload():
    plant = plants.linear_plant(control.tf([1.0, 0.0], [1.0, 1.0]), 0.1, 50.0)
    assert plants.simulate(plant, Gains(0.1, 0.0, 0.0, 0.0)).diverged_at is None
    with pytest.raises(PlantError, match="preload of 3 N"):
        plants.simulate(plant, Gains(0.1, 0.0, 0.0, 0.0), StepProfile(3.0, 1.0, 0.1, 1.0))


def test_effect_on_a_linear_plant_equals_an_extended_plant():
    gains, profile = Gains(0.02, 0.2, 0.0, 0.1), StepProfile(7.0, 1.0, 0.1, 4.0)
    for name in ("lag", "resonance", "integrator"):
        plain, stronger = (plants.linear_plant(k * SYSTEMS[name], 0.1, 50.0) for k in (1.0, 1.2))
        later = plants.linear_plant(SYSTEMS[name], 0.115, 50.0)
        for effect, meant in ((GainError(0.2), stronger), (DeadTime(0.015), later)):
            trials = [plants.simulate(plant, gains, profile) for plant in (plain + effect, meant)]
            assert trials[0].tension_N == pytest.approx(trials[1].tension_N, abs=1e-9)


def test_discrete_model_matches_the_sampled_continuous_model():
    continuous = SYSTEMS["resonance"]
    gains = Gains(0.2, 1.0, 0.0, 0.0)
    trials = [
        plants.simulate(plant, gains, StepProfile(2.0, 1.0, 0.1, 3.0))
        for plant in (
            plants.linear_plant(continuous, 0.04, 50.0),
            plants.linear_plant(continuous.sample(0.02), 0.04),
        )
    ]
    assert trials[0].tension_N == pytest.approx(trials[1].tension_N, abs=1e-9)


def test_linear_plants_of_one_order_share_one_compilation():
    a, b = (plants.linear_plant(control.tf([1.0], [T, 1.0]), T, 50.0) for T in (0.5, 3.0))
    assert a.structure == b.structure


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: plants.linear_plant(3.0), InvalidInput, "float"),
        (
            lambda: plants.linear_plant(control.tf([1.0, 0.0, 0.0], [1.0, 1.0])),
            InvalidInput,
            "zeros",
        ),
        (
            lambda: plants.linear_plant(control.ss(-np.eye(2), np.eye(2), np.eye(2), 0)),
            InvalidInput,
            "2 inputs",
        ),
        (lambda: plants.linear_plant(SYSTEMS["lag"], -1.0), InvalidInput, "dead time"),
        (lambda: plants.linear_plant(SYSTEMS["lag"], 0.0, float("nan")), InvalidInput, "sampling"),
        (
            lambda: plants.linear_plant(SYSTEMS["lag"], output_min_N=1.0, output_max_N=0.0),
            InvalidInput,
            "not in order",
        ),
        (lambda: plants.linear_plant(SYSTEMS["lag"].sample(0.1), 0.0, 50.0), PlantError, "50 Hz"),
        (
            lambda: plants.linear_plant(SYSTEMS["lag"].sample(0.1), 0.05),
            PlantError,
            "whole number",
        ),
        (
            lambda: plants.linear_plant(control.tf([1.0], [1.0, 0.5], dt=True)),
            InvalidInput,
            "sampling_Hz",
        ),
        (lambda: plants.linear_plant(SYSTEMS["unstable"]).rig(), UnsafeStart, "gains"),
    ],
)
def test_linear_plant_rejects_unusable_models(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_linear_plant_chooses_safe_gains():
    for name in ("lag", "resonance", "eighth order", "integrator"):
        plant = plants.linear_plant(SYSTEMS[name], 0.2)
        gains = plant.describe("model", None).gains
        trial = plants.simulate(plant, gains)
        assert np.abs(trial.tension_N).max() < 1.5
        assert min(gains.as_tuple()) > 0.0  # or it would not be tuned


@pytest.mark.parametrize(("gain", "dead_time_s"), [(0.02, 2.0), (50.0, 0.01), (1e-3, 60.0)])
def test_integrator_with_dead_time_has_the_safe_gains_of_another_scaled(gain, dead_time_s):
    def safe(gain, dead_time_s):
        plant = plants.linear_plant(control.tf([gain], [1.0, 0.0]), dead_time_s)
        return plant.describe("plant", None)

    scaled, one = safe(gain, dead_time_s), safe(1.0, 1.0)
    P, I, D, F = one.gains.as_tuple()
    times = np.array([1.0, 1.0 / dead_time_s, dead_time_s]) / (gain * dead_time_s)
    expected = [*(times * (P, I, D)), F * dead_time_s]
    assert scaled.gains.as_tuple() == pytest.approx(expected, rel=1e-6)
    assert scaled.settling_time_s == pytest.approx(one.settling_time_s * dead_time_s)


def test_settling_time_of_an_integrator_follows_rate_effort_and_gain():
    def settling_s(gain, rate=None, most=1e9):
        system = control.tf([gain], [1.0, 0.0])
        limits = {"output_min_N": -most, "output_max_N": most}
        return plants.linear_plant(system, 0.0, rate, **limits).mounting.settling_time_s

    assert settling_s(0.02) == pytest.approx(100.0 * settling_s(2.0))
    assert settling_s(0.02, rate=50.0) == pytest.approx(4.0)
    assert settling_s(0.02, rate=50.0, most=10.0) == pytest.approx(2.0 * np.pi * 5.0)


def test_integrator_with_delays_as_poles_at_zero_is_that_with_dead_time():
    plain, late = (
        control.tf([0.002], [1.0, -1.0], 0.1),
        control.tf([0.002], [1.0, -1.0, 0, 0], 0.1),
    )
    limits = {"output_min_N": 0.0, "output_max_N": 1e3}
    one = plants.linear_plant(plain, 0.2, **limits)
    other = plants.linear_plant(late, **limits)
    assert other.mounting.settling_time_s == pytest.approx(one.mounting.settling_time_s)
    assert other.describe("plant", None).gains.as_tuple() == pytest.approx(
        one.describe("plant", None).gains.as_tuple(), rel=1e-6
    )


def lag(state, effort, dt_s):
    """x' = (2 u - x)/0.5, exactly."""
    following = 2.0 * effort + (state - 2.0 * effort) * np.exp(-dt_s / 0.5)
    return following, following


@pytest.mark.parametrize("dead_samples", [0.0, 3.0, 2.6])
def test_python_plant_matches_the_same_linear_model(dead_samples):
    step = StepProfile(0.0, 1.0, 0.1, 3.0)
    gains, limits = Gains(0.8, 2.0, 0.01, 0.05), {"output_min_N": -1.0, "output_max_N": 0.6}
    model = plants.linear_plant(SYSTEMS["lag"], dead_samples / 50.0, 50.0, **limits)
    function = plants.python_plant(
        lag, 0.0, sampling_Hz=50.0, settling_time_s=1.0, dead_time_s=dead_samples / 50.0, **limits
    )
    a, b = (plants.simulate(plant, gains, step) for plant in (model, function))
    assert a.tension_N == pytest.approx(b.tension_N, abs=1e-10)
    assert a.effort_N == pytest.approx(b.effort_N, abs=1e-10)
    assert np.array_equal(a.flags, b.flags)
    assert a.flags.any()


def test_python_plant_copies_its_initial_state_for_each_trial():
    def tank(state, effort, dt_s):
        state["level"] += effort * dt_s
        return state, state["level"]

    plant = plants.python_plant(tank, {"level": 0.0}, sampling_Hz=20.0, settling_time_s=1.0)
    first, second = (plants.simulate(plant, Gains(1.0, 0.0, 0.0, 0.0)) for _ in range(2))
    assert np.array_equal(first.tension_N, second.tension_N)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "NoneType"),
        (1.0, "float"),
        ((1.0,), "1 values"),
        ((1.0, 2.0, 3.0), "3 values"),
        ((0.0, [1.0, 2.0]), r"shape \(2,\)"),
        ((0.0, "high"), "'high'"),
        ((0.0, float("nan")), "nan"),
        ((0.0, float("inf")), "inf"),
    ],
)
def test_python_plant_rejects_wrong_return_values(answer, message):
    plant = plants.python_plant(
        lambda _state, _effort, _dt: answer, 0.0, sampling_Hz=20.0, settling_time_s=1.0
    )
    with pytest.raises(PlantError, match=message) as caught:
        plants.simulate(plant, Gains(1.0, 0.0, 0.0, 0.0))
    assert "sample 0" in str(caught.value)
    assert "(state, measurement)" in str(caught.value)


def test_python_plant_reports_exceptions_of_its_function():
    def broken(_state, _effort, _dt):
        raise ZeroDivisionError("no mass")

    plant = plants.python_plant(broken, 0.0, sampling_Hz=20.0, settling_time_s=1.0)
    with pytest.raises(PlantError, match="ZeroDivisionError at sample 0: no mass"):
        plants.simulate(plant, Gains(1.0, 0.0, 0.0, 0.0))


def test_python_plant_without_gains_is_identified_in_open_loop_and_tuned():
    efforts = []

    def oven(T, effort, dt_s):
        efforts.append(effort)
        T = T + dt_s * (0.02 * effort - (T - 20.0) / 300.0)
        return T, T

    plant = plants.python_plant(
        oven, 20.0, sampling_Hz=0.5, settling_time_s=400.0, initial_measurement_N=20.0,
        output_min_N=0.0, output_max_N=100.0, noise_rms_N=0.003,
    )  # fmt: skip
    rig = plant.rig()
    assert min(rig.describe().gains.as_tuple()) > 0.0
    result = estune.tune(rig, trials=12, journal=False, watch=None)
    assert result.verdict.change.estimate < -0.5
    assert 0.0 <= min(efforts) <= max(efforts) <= 100.0


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda x, u, dt: (x - dt * 5.0 * (x + u),) * 2, "turn the sign"),
        (lambda x, u, dt: (x + dt * (5.0 * x + u),) * 2, "unstable by itself"),
        (lambda x, u, dt: (x + dt * (u + 1.0),) * 2, "does not stay at rest"),
        (lambda x, _u, _dt: (x, 0.0), "does not move it"),
    ],
)
def test_python_plant_that_cannot_be_identified_says_why_and_asks_for_gains(step, words):
    plant = plants.python_plant(step, 0.0, sampling_Hz=200.0, settling_time_s=0.5)
    with pytest.raises(UnsafeStart, match=rf"{words}.*give gains that hold it stable"):
        plant.rig()
    assert plant.rig(gains=Gains(1.0, 0.0, 0.0, 0.0)).describe().gains.P == 1.0


def test_python_function_that_shortens_its_state_is_refused():
    def half(state, effort, dt_s):
        return (state[0] + dt_s * (effort - state[0]),), state[0]

    plant = plants.python_plant(half, (0.0, 0.0), sampling_Hz=100.0, settling_time_s=1.0)
    with pytest.raises(PlantError, match="state of length 1 where the initial state has length 2"):
        plant.rig()
