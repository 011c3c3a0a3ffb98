import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import plants
from estune.core.gains import Gains
from plants.models.reel_equations import cable_stiffness_N_m
from tests.support_lanes import first_by_day

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


@pytest.mark.parametrize("dead_time_s", first_by_day(2.3 * h, 0.0, h, 0.45 * h))
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
