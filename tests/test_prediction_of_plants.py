"""Predictions of linear plants, of functions and of an unloaded reel."""

from dataclasses import replace

import casadi as ca
import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import plants
from estune.errors import PlantError
from estune.trial.profiles import ChirpProfile
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import (
    EFFECTS,
    CoulombFriction,
    TorqueRipple,
)
from tests.support_prediction import GAINS, SMALL, measure


def swinging(sampling_Hz=500.0, hardening=40.0, slope=0.0):
    """Oscillator with a cubic spring, by another integrator.

    Within a sample its input moves by the fraction `slope` of the way to the next sample.
    """
    w, z, gain = 2.0 * np.pi * 6.0, 0.05, 0.5
    time = np.arange(1000) / sampling_Hz
    u = 1.5 * np.sin(2.0 * np.pi * (2.0 + 3.0 * time) * time) + 0.3
    if sampling_Hz < 100.0:
        u = np.random.default_rng(5).normal(size=time.size)

    def rate(t, x, k):
        spring = x[0] / gain + hardening * (x[0] / gain) ** 3
        input_now = u[k] + slope * t * sampling_Hz * (u[k + 1] - u[k])
        return [x[1], gain * w**2 * (input_now - spring) - 2.0 * z * w * x[1]]

    states = [np.zeros(2)]
    for k in range(time.size - 1):
        solution = solve_ivp(
            rate, (0.0, 1.0 / sampling_Hz), states[-1], args=(k,), rtol=1e-10, atol=1e-12
        )
        states.append(solution.y[:, -1])
    y = np.array(states)[:, 0]
    plant = plants.linear_plant(
        control.tf([gain * w**2], [1.0, 2.0 * z * w, w**2]), sampling_Hz=sampling_Hz
    )
    return plant, MeasuredRecord(
        name="swing",
        rig="rig",
        sampling_Hz=sampling_Hz,
        loop="open",
        profile="chirp",
        time_s=time,
        setpoint_N=u,
        tension_N=y,
    )


def test_linear_plant_with_cubic_spring_solves_its_equation():
    hardening = 0.4
    plant, record = swinging(hardening=hardening)
    model = diagnosed(plant, [record])
    spring = EFFECTS["cable_stiffening"]
    predictor = Predictor(model, [spring], [record], None, SMALL)
    newton = model.model.torque_unit * 0.01  # a newton of the cable, in units of the input
    values = {"cable_stiffening.cubic_per_N2": hardening * newton**2}
    values |= {"cable_stiffening.stiffening_per_N": 0.0, "input_slope": 0.0}
    row = predictor.row(values)
    (predicted,) = predictor.predict(row[None])
    linear = predictor.predict(
        predictor.row(values | {"cable_stiffening.cubic_per_N2": 0.0})[None]
    )
    assert np.abs(linear[0].tension_N[0] - record.tension_N).max() > 0.3 * record.tension_N.std()
    assert predicted.tension_N[0] == pytest.approx(
        record.tension_N, abs=3e-3 * record.tension_N.std()
    )
    fitted = model.calibrated(predictor.values(row), [spring])
    drive = ChirpProfile(0.0, 1.0, 2.0, 12.0, 2.0, loop="open")
    simulated = plants.simulate(fitted, GAINS, drive).tension_N
    again = replace(record, setpoint_N=drive.setpoint(500.0), tension_N=simulated)
    predictor = Predictor(model, [spring], [again], None, SMALL)
    (predicted,) = predictor.predict(predictor.row(values)[None])
    assert predicted.tension_N[0] == pytest.approx(simulated, abs=1e-9)


def test_first_order_hold_of_the_input_is_detected():
    for slope in (0.0, 1.0):
        plant, record = swinging(sampling_Hz=80.0, hardening=0.0, slope=slope)
        predictor = Predictor(diagnosed(plant, [record]), [], [record], None, SMALL)
        assert predictor.values(predictor.start)["input_slope"] == slope
        (predicted,) = predictor.predict(predictor.start[None])
        off = np.std(predicted.tension_N[0] - record.tension_N)
        assert off < 2e-3 * record.tension_N.std()
        other = predictor.row({"input_slope": 1.0 - slope})
        wrong = predictor.predict(other[None])[0].tension_N[0]
        assert np.std(wrong - record.tension_N) > 20.0 * off


def test_linear_plant_effects_need_a_velocity_and_a_spring():
    record = swinging()[1]
    lag, integrator = (diagnosed(control.tf(1, d), [record]) for d in ([1, 1], [1, 1, 0]))
    assert "position" in lag.unavailable(CoulombFriction)
    assert integrator.unavailable(CoulombFriction) is None
    assert integrator.unavailable(EFFECTS["cable_stiffening"])
    for model in (lag, integrator):
        assert model.unavailable(EFFECTS["current_saturation"]) is None
        assert model.unavailable(EFFECTS["gauge_nonlinearity"]) is None
    spring = diagnosed(swinging()[0], [record])
    assert "cable_length_m" in spring.unavailable(EFFECTS["string_mode"])
    assert "angle of a drum" in spring.unavailable(EFFECTS["torque_ripple"])
    assert "slack" in spring.unavailable(EFFECTS["cable_slack"])


def pendulum(state, effort, dt_s):
    angle, rate = state
    rate = rate + dt_s * (30.0 * effort - 400.0 * np.sin(angle) - 2.0 * rate)
    return (angle + dt_s * rate, rate), angle


def test_prediction_of_a_python_function_equals_its_run():
    plant = plants.python_plant(
        pendulum, (0.0, 0.0), sampling_Hz=400.0, settling_time_s=0.5, dead_time_s=2.3 / 400.0
    )
    chirp = ChirpProfile(0.0, 1.0, 0.5, 6.0, 2.0, loop="open")
    record = measure(plant, chirp)
    model = diagnosed(plant, [record])
    limit = EFFECTS["current_saturation"]
    predictor = Predictor(model, [limit], [record], floor=SMALL)
    assert predictor.horizon_s is None
    values = {"input_gain": 1.0, "current_saturation.limit_A": 1e6}
    (predicted,) = predictor.predict(predictor.row(values)[None])
    assert predicted.tension_N[0] == pytest.approx(record.tension_N, abs=1e-9)
    values |= {"input_gain": 0.9, "output_offset": 0.2, "current_saturation.limit_A": 0.06}
    fitted = model.calibrated(values, [limit])
    again = plants.simulate(fitted, GAINS, chirp).tension_N
    (predicted,) = predictor.predict(predictor.row(values)[None])
    assert predicted.tension_N[0] == pytest.approx(again, abs=1e-9)
    assert "inside" in model.unavailable(CoulombFriction)


def branching(state, effort, dt_s):
    return (state + dt_s * effort if effort > 0.0 else state), state


def branchless(state, effort, dt_s):
    return state + dt_s * ca.if_else(effort > 0.0, effort, 0.0), state


def test_branching_function_is_refused_with_advice():
    record = swinging()[1]
    settings = {"sampling_Hz": 500.0, "settling_time_s": 1.0}
    with pytest.raises(PlantError, match=r"casadi\.if_else") as caught:
        diagnosed(plants.python_plant(branching, 0.0, **settings), [record])
    assert "\n" not in str(caught.value)
    diagnosed(plants.python_plant(branchless, 0.0, **settings), [record])


def test_prediction_of_an_unloaded_reel_equals_its_run():
    reel = plants.unloaded_reel(encoder_counts=1e12) + CoulombFriction(0.05)
    push = ChirpProfile(0.0, 20.0, 1.0, 8.0, 2.0, loop="open")
    record = measure(reel, push)
    bare = replace(reel, effects=())
    model = diagnosed(bare, [record])
    assert model.output == "rad"
    for horizon in (None, "model"):
        predictor = Predictor(model, [CoulombFriction], [record], horizon, SMALL)
        row = predictor.row({"coulomb_friction.torque_Nm": 0.05})
        (predicted,) = predictor.predict(row[None])
        limit = 1e-9 if horizon is None else 1e-3 * record.angle_rad.std()
        assert np.abs(predicted.angle_rad[0] - record.angle_rad).max() < limit
        assert predicted.tension_N is None
    fitted = model.calibrated(
        predictor.values(row) | {"torque_offset_Nm": 0.01}, [CoulombFriction]
    )
    predictor = Predictor(model, [CoulombFriction], [record], None, SMALL)
    row = predictor.row({"coulomb_friction.torque_Nm": 0.05, "torque_offset_Nm": 0.01})
    again = plants.simulate(fitted, GAINS, push).angle_rad
    assert predictor.predict(row[None])[0].angle_rad[0] == pytest.approx(again, abs=1e-9)


def test_phase_of_a_wave_is_independent_of_the_encoder_zero():
    ripple = TorqueRipple(0.005, 46.0, 0.7)
    reel = plants.unloaded_reel(encoder_counts=1e12) + ripple
    push, zeros = ChirpProfile(0.0, 20.0, 1.0, 8.0, 2.0, loop="open"), {0: 0.0, 1: 1.7}
    first = measure(reel, push)
    records = [first, replace(first, name="b", angle_rad=first.angle_rad + zeros[1])]
    model = diagnosed(replace(reel, effects=()), records)
    predictor = Predictor(model, [TorqueRipple], records, floor=SMALL)
    rows = predictor.start + np.zeros((2, 1))
    for n, f in enumerate(predictor.free):
        if f.owner == "torque_ripple":
            rows[:, n] = getattr(ripple, f.name.rpartition(".")[2])
        elif f.owner.startswith("record "):
            rows[:, n] = zeros[int(f.owner.removeprefix("record "))]
            rows[1, n] += 9.0 * 2.0 * np.pi / ripple.per_turn  # nine periods give equal results
    for record, predicted in zip(records, predictor.predict(rows), strict=True):
        wrong = np.abs(predicted.angle_rad - record.angle_rad).max(axis=1)
        assert (wrong < 1e-3 * np.std(record.angle_rad)).all()


@pytest.mark.parametrize("wandering", [False, True])
def test_sigma_of_a_free_drum_is_that_of_its_windows(wandering):
    drum = plants.unloaded_reel(viscous_friction_Nms=1e-9, dead_time_s=0.0)
    h, count = 1.0 / drum.sampling_Hz, 2.0 * np.pi / drum.encoder_counts
    rng, samples = np.random.default_rng(2), np.arange(20 * 316)
    turn, stray = 2.0 * np.pi * samples / 316, np.zeros(samples.size)
    push = 2.0 * np.sin(turn) + np.cos(7.0 * turn) + np.sin(31.0 * turn)
    for n in samples[1:] if wandering else ():
        stray[n] = 0.9 * stray[n - 1] + 0.05 * rng.normal()
    rate = (push + stray) * drum.drum_radius_m / drum.drum_inertia_kg_m2
    velocity = 5.0 + h * np.append(0.0, np.cumsum(rate)[:-1])
    angle = h * np.append(0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1])))
    record = MeasuredRecord(
        name="turned",
        rig="rig",
        sampling_Hz=drum.sampling_Hz,
        loop="open",
        profile="sine",
        time_s=h * samples,
        setpoint_N=push,
        angle_rad=count * np.round(angle / count),
    )
    predictor = Predictor(diagnosed(drum, [record]), [], [record])
    residuals = predictor.residuals(predictor.start[None])
    assert predictor.index.sigma.max() < 1e-3 * record.angle_rad.std()
    assert 0.5 < np.sqrt(np.mean(residuals**2)) < 1.3


def test_offset_of_an_input_does_not_bend_the_spring_that_is_found():
    plant, m = swinging(hardening=0.2)
    noise = 3e-4 * np.random.default_rng(0).standard_normal(m.samples)
    m = replace(m, setpoint_N=m.setpoint_N - 0.2, tension_N=m.tension_N + noise)
    d = plants.explain(plant, [m], effects=["cable_stiffening"])
    cubic = d.effects[0].parameters["cubic_per_N2"]
    assert cubic.low < 0.2 < cubic.high < 1.5 * cubic.low
