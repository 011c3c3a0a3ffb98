from copy import copy
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, PlantError
from estune.trial.profiles import ChirpProfile, MultisineProfile, StepProfile, TriangleProfile
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import Noise, NoiseFloor
from plants.diagnosis.models.calibration import Calibration
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import (
    EFFECTS,
    CoulombFriction,
    DeadTime,
    EyeletFriction,
    TorqueRipple,
)

GAINS = Gains(0.4, 12.0, 0.01, 0.03)
REEL = plants.reference_reel(encoder_counts=1e12)
LINES = MultisineProfile(15.0, 4.0, 1.0, 1, 60, 2.2, start_s=0.1, lines="odd", loop="open")
PROFILES = (
    replace(LINES, duration_s=1.2),
    StepProfile(15.0, 8.0, 0.1, 0.8),
    TriangleProfile(15.0, 6.0, 0.5, 0.7, start_s=0.1, loop="open"),
)


def measure(model, profile, *, noise_N=0.0, seed=0, name="a"):
    """Simulated record of a model, at its own length and rate."""
    rate = model.controller.sampling_Hz
    noise = noise_N * np.random.default_rng(seed).normal(size=profile.samples(rate))
    response = plants.simulate(model, GAINS, profile, noise_N=noise)
    return MeasuredRecord(
        name=name,
        rig="rig",
        sampling_Hz=rate,
        cable_length_m=getattr(model, "cable_length_m", None),
        preload_N=profile.preload_N,
        loop=profile.loop,
        profile=profile.kind,
        gains=GAINS,
        time_s=response.time_s,
        setpoint_N=response.setpoint_N,
        tension_N=response.tension_N if response.tension_N.any() else None,
        current_A=response.effort_N / model.newtons_per_ampere,
        angle_rad=response.angle_rad if response.angle_rad.any() else None,
        reference_N=response.reference_N,
        flags=response.flags,
    )


def floor(**rms):
    channels = {name: Noise(value, 0.0, "quiet stretches") for name, value in rms.items()}
    return NoiseFloor(channels)


SMALL = floor(tension_N=1e-3, angle_rad=1e-5, reference_N=1e-3, current_A=1e-4)


def truth(predictor, *effects):
    """Parameter row with the effects' own values, the model's other values and zeroed encoders."""
    values = {f"{e.name}.{n}": getattr(e, n) for e in effects for n in e.parameters()}
    zeros = {f.name: 0.0 for f in predictor.free if f.name.startswith("encoder_zero")}
    return predictor.row(values | zeros)


def sweep(model):
    """Records of three lengths, preloads, rates and profiles, one of them in closed loop."""
    lengths, rates, preloads = (0.5, 0.9, 1.4), (632.0, 632.0, 1000.0), (15.0, 20.0, 12.0)
    return [
        measure(
            replace(model, cable_length_m=length, sampling_Hz=rate, tension_N=preload),
            replace(profile, preload_N=preload),
            name=f"record {length}",
        )
        for profile, length, rate, preload in zip(PROFILES, lengths, rates, preloads, strict=True)
    ]


OF_REELS = [name for name, effect in EFFECTS.items() if not effect.without_cable]


@pytest.mark.parametrize("name", [None, *OF_REELS])
def test_free_run_with_true_parameters_equals_the_simulation(name):
    effects = [] if name is None else [EFFECTS[name]()]
    records = sweep(REEL + effects[0] if effects else REEL)
    predictor = Predictor(
        diagnosed(REEL, records), [type(e) for e in effects], records, None, SMALL
    )
    for record, predicted in zip(
        records, predictor.predict(truth(predictor, *effects)[None]), strict=True
    ):
        assert predicted.tension_N[0] == pytest.approx(record.tension_N, abs=2e-8)
        assert predicted.angle_rad[0] == pytest.approx(record.angle_rad, abs=1e-9)
        if record.reference_N is not None:
            assert predicted.reference_N[0] == pytest.approx(record.reference_N, abs=2e-8)
        assert predicted.current_A is None  # none was measured


@lru_cache(maxsize=1)
def noisy():
    """Records of a bare reel with a noisy gauge, and their predictor."""
    records = [measure(REEL, LINES, noise_N=0.2, seed=n, name=f"noisy {n}") for n in range(3)]
    noise_floor = floor(tension_N=0.2, angle_rad=1e-5)
    return records, Predictor(diagnosed(REEL, records), [], records, floor=noise_floor)


def test_residual_of_noise_is_white_with_unit_variance():
    _, predictor = noisy()
    index, residuals = predictor.index, predictor.residuals(truth(predictor)[None])[0]
    gauge = index.channel == 0
    allowed = (0.2 / index.sigma[gauge]) ** 2
    assert np.mean(residuals[gauge] ** 2) == pytest.approx(np.mean(allowed), rel=0.05)
    samples = gauge.sum()
    for lag in (1, 2, 5):
        together = np.mean(residuals[gauge][lag:] * residuals[gauge][:-lag])
        assert abs(together) < 4.0 / np.sqrt(samples)
    # Without quantisation, only the error of the initial states remains.
    assert np.mean(residuals[~gauge] ** 2) < 0.01


def test_residual_is_independent_of_initial_states():
    _, predictor = noisy()
    row = truth(predictor)[None]
    before = predictor.residuals(row)
    place = predictor._data.window_place
    moved = copy(predictor)
    moved._runner = copy(predictor._runner)
    shift = np.random.default_rng(1).normal(size=place.shape) * (1e-3, 0.1)
    moved._runner._data = replace(predictor._data, window_place=place + shift)
    change = predictor.predict(row)[0].angle_rad - moved.predict(row)[0].angle_rad
    change = np.abs(change).max() / predictor.index.sigma[predictor.index.channel == 1][0]
    assert change > 10.0
    # The tolerance covers gauge ringing from one window to the next.
    assert np.abs(moved.residuals(row) - before).max() < 1e-3 * change


def test_derivative_equals_the_central_difference():
    records = sweep(REEL + CoulombFriction(0.03))
    predictor = Predictor(diagnosed(REEL, records), [CoulombFriction], records, floor=SMALL)
    values = predictor.row({"coulomb_friction.torque_Nm": 0.03, "torque_gain": 1.02})
    residuals, jacobian = predictor.linearise(values)
    assert residuals == pytest.approx(predictor.residuals(values[None])[0])
    for n, free in enumerate(predictor.free):
        step = 1e-5 * (abs(values[n]) or 1.0)
        rows = np.repeat(values[None], 2, axis=0)
        rows[:, n] += (-step, step)
        behind, ahead = predictor.residuals(rows)
        slope = (ahead - behind) / (2.0 * step)
        off = np.linalg.norm(jacobian[:, n] - slope) / np.linalg.norm(slope)
        assert off < 0.02, free.name
        if free.owner.startswith("record"):
            elsewhere = predictor.index.measurement != int(free.owner.split()[1])
            assert not jacobian[elsewhere, n].any()
    some = np.array([2, 0])
    assert predictor.linearise(values, some)[1] == pytest.approx(jacobian[:, some])


def test_selected_entries_equal_those_of_all():
    records = [*sweep(REEL), *sweep(REEL)]
    predictor = Predictor(diagnosed(REEL, records), [CoulombFriction], records, floor=SMALL)
    values = predictor.row({"coulomb_friction.torque_Nm": 0.03, "torque_gain": 1.02})
    residuals, jacobian = predictor.linearise(values)
    last = np.flatnonzero(predictor.index.measurement == len(records) - 1)
    for some in (last, last[::3]):  # a strided view does not own its data
        assert np.array_equal(predictor.residuals(values[None], some)[0], residuals[some])
        assert predictor.linearise(values, entries=some)[1] == pytest.approx(jacobian[some])


@pytest.mark.parametrize("missing", ["angle_rad", "tension_N"])
def test_prediction_without_a_channel(missing):
    F = CoulombFriction(0.03)
    records = [replace(m, **{missing: None}) for m in sweep(REEL + F)]
    model = diagnosed(REEL, records)
    predictor = Predictor(model, [CoulombFriction], records, floor=SMALL)
    assert set(predictor.index.channel) == ({0} if missing == "angle_rad" else {1})
    assert "structure_stiffness_N_m" not in {free.name for free in predictor.free}
    with_it = predictor.residuals(truth(predictor, F)[None])
    without = predictor.residuals(truth(predictor, CoulombFriction(0.0))[None])
    assert np.mean(with_it**2) < 0.02 * np.mean(without**2)


def test_record_may_begin_in_motion():
    whole = measure(REEL, replace(LINES, start_s=0.0))
    cut = 300
    columns = ("setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
    part = replace(
        whole,
        time_s=whole.time_s[:-cut],
        **{name: getattr(whole, name)[cut:] for name in columns},
    )
    predictor = Predictor(diagnosed(REEL, [part]), [], [part], None, SMALL)
    (predicted,) = predictor.predict(truth(predictor)[None])
    off = predicted.tension_N[0] - part.tension_N
    assert np.sqrt(np.mean(off**2)) < 0.02 * part.tension_N.std()


def test_prediction_is_continuous_in_the_dead_time():
    records = [measure(REEL, LINES)]
    predictor = Predictor(diagnosed(REEL, records), [EFFECTS["dead_time"]], records, None, SMALL)
    late = np.linspace(0.0, 3.0 / 632.0, 61)
    rows = np.array([predictor.row({"dead_time.delay_s": d}) for d in late])
    tension = predictor.predict(rows)[0].tension_N
    steps = np.abs(np.diff(tension, axis=0)).max(axis=1)
    assert steps.max() < 1.2 * np.median(steps)


def test_measured_current_identifies_the_drive():
    limited = EFFECTS["current_saturation"](0.85, bend=1e-3)
    record = measure(REEL + limited, LINES)
    commanded = record.setpoint_N / REEL.newtons_per_ampere
    lag = 3  # of the current's own filter
    flown = np.clip(commanded, -0.85, 0.85)
    record = replace(record, current_A=1.1 * np.append(np.full(lag, flown[0]), flown[:-lag]) + 0.2)
    predictor = Predictor(diagnosed(REEL, [record]), [type(limited)], [record], None, SMALL)
    values = {"current_gain": 1.1, "current_offset_A": 0.2, "encoder_zero_rad[0]": 0.0}
    own = {"current_saturation.limit_A": 0.85, "current_saturation.bend": 0.0}
    row = predictor.row(values | own)
    (predicted,) = predictor.predict(row[None])
    assert predicted.current_A[0] == pytest.approx(1.1 * flown + 0.2)
    residuals = predictor.residuals(row[None])[0]
    current = predictor.index.channel == 3
    assert current.sum() > 0.9 * record.samples
    assert np.abs(residuals[current]).max() < 1e-6


def test_late_or_nan_samples_are_ignored():
    record = measure(REEL, LINES)
    flags, tension = record.flags.copy(), record.tension_N.copy()
    flags[100:110], tension[200:205] = 4, np.nan
    predictor = Predictor(
        *(diagnosed(REEL, [record]), [], [replace(record, flags=flags, tension_N=tension)]),
        floor=SMALL,
    )
    gauge, encoder = (predictor.index.sample[predictor.index.channel == c] for c in (0, 1))
    assert not np.isin(np.r_[100:110, 200:205], gauge).any()
    assert np.isin(np.r_[200:205], encoder).all()
    assert np.isfinite(predictor.residuals(predictor.start[None])).all()


def test_diverging_prediction_has_a_large_finite_residual():
    record = measure(REEL, LINES)
    predictor = Predictor(diagnosed(REEL, [record]), [], [record], None, SMALL)
    bad = predictor.row({"viscous_friction_Nms": -50.0})
    assert np.isfinite(predictor.residuals(bad[None])).all()
    assert np.mean(predictor.residuals(bad[None]) ** 2) > 1e3


@pytest.mark.parametrize("horizon", [None, "model"])
def test_calibrated_reel_reproduces_its_prediction(horizon):
    records = sweep(REEL)
    model = diagnosed(REEL, records)
    values = {
        "drum_inertia_kg_m2": 2.2e-3,
        "torque_gain": 0.93,
        "gauge_offset_N": 0.4,
        "coulomb_friction.torque_Nm": 0.02,
    }
    fitted = model.calibrated(values, [CoulombFriction])
    assert fitted.effects == (CoulombFriction(0.02), Calibration(0.93, 0.0, 0.4))
    again = sweep(fitted)
    predictor = Predictor(diagnosed(REEL, again), [CoulombFriction], again, horizon, SMALL)
    zeros = {f.name: 0.0 for f in predictor.free if f.name.startswith("encoder_zero")}
    residuals = predictor.residuals(predictor.row(values | zeros)[None])
    gauge = predictor.index.channel == 0
    assert np.sqrt(np.mean(residuals[:, gauge] ** 2)) < (1e-3 if horizon is None else 1.0)


def test_fit_starts_from_effects_and_calibration_of_the_model():
    given_model = (
        REEL + CoulombFriction(0.03) + Calibration(1.1, 0.0, 0.5) + EyeletFriction(0.9, 0.1)
    )
    records = sweep(given_model)
    model = diagnosed(given_model, records)
    predictor = Predictor(model, [], records, None, SMALL)
    starts = {f.name: f.start for f in predictor.free}
    assert (starts["torque_gain"], starts["gauge_offset_N"]) == (1.1, 0.5)
    assert starts["coulomb_friction.torque_Nm"] == 0.03
    assert starts["eyelet_friction.attenuation"] == 0.9
    predicted = predictor.predict(truth(predictor, *given_model.effects[::2])[None])
    assert predicted[0].tension_N[0] == pytest.approx(records[0].tension_N, abs=2e-8)
    later = model.calibrated({"torque_gain": 1.2})
    assert later.effects[-1] == Calibration(1.2, 0.0, 0.5)


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
    nothing = dict.fromkeys(("gains", "cable_length_m", "current_A", "angle_rad", "reference_N"))
    return plant, MeasuredRecord(
        *("swing", "rig", sampling_Hz),
        preload_N=0.0,
        loop="open",
        profile="chirp",
        time_s=time,
        setpoint_N=u,
        tension_N=y,
        flags=None,
        **nothing,
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


def test_batch_of_rows_equals_single_rows():
    plant, record = swinging(sampling_Hz=80.0, hardening=0.0, slope=1.0)
    predictor = Predictor(diagnosed(plant, [record]), [DeadTime], [record], floor=SMALL)
    ways = [(0.0, 0.04), (1.0, 0.0), (0.5, 0.3)]
    rows = np.array(
        [predictor.row({"input_slope": s, "dead_time.delay_s": late}) for s, late in ways]
    )
    alone = np.concatenate([predictor.residuals(row[None]) for row in rows])
    assert np.array_equal(predictor.residuals(rows), alone)
    assert np.abs(np.diff(alone, axis=0)).max(axis=1).min() > 1.0
    together = predictor.predict(rows)[0].tension_N
    assert np.array_equal(together[2], predictor.predict(rows[2:])[0].tension_N[0])


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


@pytest.mark.parametrize(("swing_N", "reported"), [(16.0, True), (4.0, False)])
def test_slack_cable_identifies_the_torque_offset(swing_N, reported):
    record = measure(REEL, TriangleProfile(10.0, swing_N, 0.5, 1.0, start_s=0.1, loop="open"))
    free = Predictor(diagnosed(REEL, [record]), (), [record]).free
    assert ("torque_offset_Nm" in {f.name for f in free}) == reported
    # The search starts at a just taut cable, although slack data do not determine this.
    (zero,) = (f.start for f in free if f.name.startswith("encoder_zero"))
    assert abs(zero) < 0.02 * np.ptp(record.angle_rad)


def test_unsuitable_models_and_records_are_reported():
    record = measure(REEL, LINES)
    with pytest.raises(PlantError, match="diagnosed_by"):
        diagnosed(object(), [record])
    with pytest.raises(InvalidInput, match="no records"):
        diagnosed(REEL, [])
    with pytest.raises(InvalidInput, match="angle_rad"):
        diagnosed(plants.unloaded_reel(), [replace(record, angle_rad=None)])
    drum = diagnosed(plants.unloaded_reel(), [record])
    with pytest.raises(PlantError, match="eyelet_friction is not available"):
        Predictor(drum, [EyeletFriction], [record])


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
    nothing = dict.fromkeys(("gains", "cable_length_m", "current_A", "tension_N", "reference_N"))
    record = MeasuredRecord(
        *("turned", "rig", drum.sampling_Hz),
        preload_N=0.0,
        loop="open",
        profile="sine",
        time_s=h * samples,
        setpoint_N=push,
        angle_rad=count * np.round(angle / count),
        flags=None,
        **nothing,
    )
    predictor = Predictor(diagnosed(drum, [record]), [], [record])
    residuals = predictor.residuals(predictor.start[None])
    assert predictor.index.sigma.max() < 1e-3 * record.angle_rad.std()
    assert 0.5 < np.sqrt(np.mean(residuals**2)) < 1.3


def test_drum_without_encoder_follows_a_sticking_cable():
    friction = EyeletFriction(0.9, 0.3)
    record = replace(measure(REEL + friction, PROFILES[0]), angle_rad=None, reference_N=None)
    whitened = []
    for effects in ([], [friction]):
        model, added = diagnosed(REEL, [record]), [type(e) for e in effects]
        predictor = Predictor(model, added, [record], 0.1, SMALL)
        residuals = predictor.residuals(truth(predictor, *effects)[None])
        whitened.append(np.sqrt(np.mean(residuals**2)))
    # At the velocity of the linear law, two thirds would remain.
    assert whitened[1] < 0.1 * whitened[0]
