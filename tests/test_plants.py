import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import estune
import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput, PlantError, UnsafeStart
from estune.trial.profiles import StepProfile
from plants.effects import DeadTime, GainError
from plants.models.reel_equations import cable_stiffness_N_m

REEL = plants.reference_reel()
h = 1.0 / 632.0


def open_loop(reel, effort, preload=15.0):
    """Tension reading and angle under a given effort, by the equations."""
    e = reel.structure.equations()
    whole = round(reel.dead_time_s * reel.sampling_Hz - 1e-9 - 0.5 * reel.structure.fractional)
    constants, x, _ = e.prepare(reel.parameter_values, preload)
    past = [float(e.drive(constants, x, preload)[1])] * (whole + 2)
    read = []
    for u in effort:
        x, tension, angle = e.observe(constants, x, past[-whole - 1], 0.0)
        x, drive = e.drive(constants, x, u)
        past.append(float(drive))
        read.append((float(tension), float(angle), float(x[0]), float(x[1])))
        x = e.move(constants, x, past[-whole - 2], past[-whole - 1])
    return np.array(read).T


def integrated(reel, effort, preload=15.0):
    """Response of `open_loop` by adaptive integration of the reel's differential equations."""
    R, J, L = reel.drum_radius_m, reel.drum_inertia_kg_m2, reel.cable_length_m
    b = reel.viscous_friction_Nms + reel.viscous_friction_per_length_Ns * L
    w, zeta = 2 * np.pi * reel.gauge_Hz, reel.gauge_damping
    compliance = 1 / reel.structure_stiffness_N_m + L / reel.cable_EA_N
    weight = 9.80665 * reel.cable_density_kg_m
    kR = R / (compliance + weight**2 * L**3 / (12 * preload**3))

    def rates(_, x, u):
        T = max(0.0, kR * x[0])
        return [
            x[1],
            (u * R - b * x[1] - R * T) / J,
            x[3],
            w * w * (T - x[2]) - 2 * zeta * w * x[3],
        ]

    limit = reel.current_limit_A * reel.torque_constant_Nm_A / R
    switches = np.arange(len(effort)) * h + reel.dead_time_s
    x, t, u, read = np.array([preload / kR, 0.0, preload, 0.0]), 0.0, preload, []
    pending = list(zip(switches, np.clip(effort, -limit, limit), strict=True))
    for k in range(len(effort)):
        read.append(x[2])
        while t < (k + 1) * h - 1e-12:
            if pending and pending[0][0] <= t + 1e-12:
                u = pending.pop(0)[1]
            end = min((k + 1) * h, pending[0][0] if pending else np.inf)
            x = solve_ivp(rates, (t, end), x, args=(u,), rtol=1e-11, atol=1e-12).y[:, -1]
            t = end
    return np.array(read)


def wander(samples, size, seed=1):
    """Effort that varies about the preload."""
    steps = np.random.default_rng(seed).uniform(-1.0, 1.0, samples)
    return 15.0 + size * np.convolve(steps, np.ones(8) / 3.0, "same")


@pytest.mark.parametrize("dead_time_s", [0.0, h, 2.3 * h, 0.45 * h])
def test_taut_reel_is_propagated_exactly(dead_time_s):
    reel = plants.reference_reel(dead_time_s=dead_time_s)
    effort = wander(120, 3.0)
    assert open_loop(reel, effort)[0] == pytest.approx(integrated(reel, effort), abs=2e-8)


def test_slack_reel_follows_the_differential_equation():
    effort = np.where(np.arange(150) < 60, -40.0, 20.0)
    exact = integrated(REEL, effort)
    tension = open_loop(REEL, effort)[0]
    assert (open_loop(REEL, effort)[2] < 0.0).sum() > 20  # slack for long
    assert tension == pytest.approx(exact, abs=2e-3 * np.ptp(exact))


def test_tension_at_rest_equals_effort():
    assert open_loop(REEL, np.full(3 * 632, 23.0))[0][-1] == pytest.approx(23.0, abs=1e-3)


def test_drum_and_cable_oscillate_at_their_natural_frequency():
    poles = np.linalg.eigvals(np.array(REEL.linear_model().A))
    slow = poles[np.abs(poles) < 500.0]
    k = 1.0 / (1.0 / 20e3 + 0.8 / 10e3)
    assert np.abs(slow) == pytest.approx(0.025 * np.sqrt(k / 2e-3), rel=1e-3)
    assert -slow.real == pytest.approx((0.010 + 0.015 * 0.8) / (2 * 2e-3))
    angle = open_loop(REEL, np.full(400, 20.0))[2]
    offset = angle - 20.0 / (k * 0.025)
    crossings = np.flatnonzero(np.diff(np.sign(offset)) != 0)
    exact = crossings + offset[crossings] / (offset[crossings] - offset[crossings + 1])
    assert np.diff(exact).mean() * h == pytest.approx(np.pi / slow.imag.max(), rel=2e-3)


def test_gauge_oscillates_at_its_mode():
    model = REEL.linear_model()
    poles = np.linalg.eigvals(np.array(model.A))
    fast = poles[np.abs(poles) > 500.0]
    assert np.abs(fast) == pytest.approx(2 * np.pi * 290.0)
    assert -fast.real / np.abs(fast) == pytest.approx(0.03)


def test_linear_model_matches_the_taut_reel():
    model, effort = REEL.linear_model(), wander(200, 2.0)
    system = control.ss(model.A, np.array(model.B)[:, None], model.C, 0.0).sample(h)
    late = np.concatenate([[15.0], effort[:-1]])  # one sample of dead time
    expected = control.forced_response(system, U=late - 15.0, T=np.arange(200) * h).outputs
    assert open_loop(REEL, effort)[0] - 15.0 == pytest.approx(expected, abs=1e-4)


def test_cable_stiffness_includes_the_sag_of_a_parabola():
    reel = plants.reference_reel(1.4, cable_density_kg_m=0.05)

    def span(T):
        """Length taken up at tension T: elastic stretch less the parabola's shortening."""
        w, L = 9.80665 * 0.05, 1.4
        return T / 20e3 + T * L / 10e3 - w**2 * L**3 / (24.0 * T**2)

    for T in (5.0, 10.0, 40.0):
        slope = (span(T * 1.0001) - span(T * 0.9999)) / (T * 0.0002)
        assert cable_stiffness_N_m(reel, T) == pytest.approx(1.0 / slope, rel=1e-6)
    assert cable_stiffness_N_m(reel, 5.0) < 0.5 * cable_stiffness_N_m(reel, 40.0)


def test_current_is_limited():
    above_limit, at = (open_loop(REEL, np.full(100, effort))[0] for effort in (1e4, 120.0))
    assert above_limit == pytest.approx(at)


def test_dead_time_delays_by_whole_samples():
    effort = np.full(40, 25.0)
    prompt, late = (open_loop(plants.reference_reel(dead_time_s=n * h), effort)[0] for n in (0, 7))
    assert late[7:] == pytest.approx(prompt[:-7])
    assert late[:8] == pytest.approx(15.0)


def test_encoder_angle_is_quantised():
    _, read, true, _ = open_loop(REEL, wander(100, 3.0))
    counts = read / (2 * np.pi / 8192)
    assert counts == pytest.approx(np.round(counts), abs=1e-6)
    assert np.abs(read - true).max() <= np.pi / 8192 * (1 + 1e-9)


def test_coulomb_friction_reduces_each_half_swing_by_a_constant():
    F = 0.005
    frictionless = plants.reference_reel(
        viscous_friction_Nms=0.0, viscous_friction_per_length_Ns=0.0, dead_time_s=0.0
    )
    reel = frictionless + plants.CoulombFriction(torque_Nm=F)
    stiffness = cable_stiffness_N_m(reel, 15.0) * reel.drum_radius_m**2
    angle = open_loop(reel, np.full(632, 18.0))[2] - 18.0 * reel.drum_radius_m / stiffness
    turns = np.flatnonzero(np.diff(np.sign(np.diff(angle))) != 0) + 1
    swings = np.abs(angle[turns])[:4]
    # Free of damping, every half swing loses 2 F/k.
    assert np.diff(swings) == pytest.approx(-2 * F / stiffness, rel=0.03)


def test_coulomb_friction_holds_the_drum_and_adds_no_energy():
    reel = REEL + plants.CoulombFriction(torque_Nm=0.05)
    stuck = open_loop(reel, np.full(100, 16.9))  # 1.9 N at 0.025 m is less than the friction
    assert np.ptp(stuck[2]) < 1e-12
    assert np.abs(stuck[3]).max() < 1e-12
    *_, angle, velocity = open_loop(reel, np.where(np.arange(400) < 50, 30.0, 15.0))
    k = cable_stiffness_N_m(reel, 15.0) * reel.drum_radius_m**2
    energy = 0.5 * 2e-3 * velocity**2 + 0.5 * k * (angle - 15.0 * 0.025 / k) ** 2
    assert np.all(np.diff(energy[52:]) <= 1e-15)
    assert np.abs(velocity[-1]) < 1e-12


def test_plants_have_a_short_repr():
    motor = plants.python_plant(
        shifted, 0.0, sampling_Hz=100.0, settling_time_s=1.0, gains=Gains(1.0, 0.0, 0.0, 0.0)
    )
    linear = plants.linear_plant(control.tf([1.0], [0.2, 1.0]), 0.31, 50.0)
    reel = plants.reference_reel(1.1, 20.0, gauge_Hz=250.0)
    assert repr(reel) == "Reel(cable_length_m=1.1, tension_N=20, gauge_Hz=250)"
    assert repr(reel + plants.CoulombFriction(0.02)).startswith(f"{reel!r} + CoulombFriction(")
    assert repr(plants.unloaded_reel()) == "UnloadedReel()"
    assert repr(linear) == "LinearPlant(order 1, dead time 0.31 s, 50 Hz)"
    assert repr(motor) == "PythonPlant(shifted, 100 Hz)"
    assert repr(reel.rig(name="a")) == f"SimulatedRig('a', {reel!r})"
    assert repr(plants.simulate(reel, reel.describe("a", None).gains)) == (
        "Response(632 samples, complete)"
    )


def shifted(state, effort, dt_s):
    return state + dt_s * (effort - state), state


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
