import math
from dataclasses import replace

import control
import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, PlantError
from estune.trial import TrialRequest
from estune.trial.profiles import ChirpProfile, StepProfile
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import Noise, NoiseFloor
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import EFFECTS, CoulombFriction, DeadTime, Port, TorqueRipple

FINE = plants.unloaded_reel(encoder_counts=1e12)  # so that the angle can be compared to rounding
PUSH = StepProfile(0.0, 10.0, 0.1, 0.6, loop="open")
GAINS = Gains(1.0, 0.0, 0.0, 0.0)


def angle(reel, profile=PUSH):
    return plants.simulate(reel, GAINS, profile).angle_rad


def step_response(reel, time_s, torque_Nm):
    """Closed-form solution of J theta'' + b theta' = tau from rest under a step at zero."""
    J, b = reel.drum_inertia_kg_m2, reel.viscous_friction_Nms
    t = np.maximum(time_s, 0.0)
    return torque_Nm / b * (t + J / b * np.expm1(-b / J * t))


@pytest.mark.parametrize("dead_samples", [0.0, 1.0, 2.6])
def test_unloaded_reel_follows_the_differential_equation(dead_samples):
    reel = replace(FINE, dead_time_s=dead_samples / FINE.sampling_Hz)
    simulated = angle(reel)
    start = PUSH.step_index(reel.sampling_Hz) + dead_samples
    time = (np.arange(simulated.size) - start) / reel.sampling_Hz
    expected = step_response(reel, time, 10.0 * reel.drum_radius_m)
    assert simulated == pytest.approx(expected, abs=1e-10)


def test_unloaded_reel_with_dry_friction_holds_small_torques():
    F = 0.1
    reel = FINE + CoulombFriction(F)
    assert not angle(reel, replace(PUSH, step_N=0.9 * F / reel.drum_radius_m)).any()
    time = (np.arange(angle(reel).size) - PUSH.step_index(632.0) - 1) / 632.0
    assert angle(reel) == pytest.approx(step_response(reel, time, 0.25 - F), abs=1e-6)


def test_unloaded_reel_of_radius_one_is_a_positioning_stage():
    stage = plants.unloaded_reel(
        drum_radius_m=1.0,
        torque_constant_Nm_A=1.0,
        drum_inertia_kg_m2=8.0,
        viscous_friction_Nms=40.0,
        current_limit_A=500.0,
        dead_time_s=0.0,
        sampling_Hz=2000.0,
        encoder_counts=2.0 * math.pi / 1e-12,
    )
    time = np.arange(1200) / 2000.0 - 0.1
    assert angle(stage) == pytest.approx(step_response(stage, time, 10.0), abs=1e-10)


def test_unloaded_reel_angle_is_quantised():
    reel = plants.unloaded_reel()
    step = 2.0 * math.pi / reel.encoder_counts
    assert angle(reel) == pytest.approx(np.floor(angle(FINE) / step + 0.5) * step)


def test_unloaded_reel_rig_rejects_closed_loops():
    rig = plants.unloaded_reel().rig()
    about = rig.describe()
    record = rig.run(TrialRequest("run", 0, about.gains, about.step))
    assert record.loop == "open"
    assert record.cable_length_m is None
    assert not record.tension_N.any()
    assert record.angle_rad[-1] > 1.0
    closed = StepProfile(0.0, 1.0, 0.1, 0.5)
    with pytest.raises(PlantError, match="open loop"):
        rig.run(TrialRequest("run", 1, about.gains, closed))


def test_unloaded_reel_matches_its_linear_model():
    reel = replace(FINE, dead_time_s=0.0)
    model = reel.linear_model()
    plant = plants.linear_plant(
        control.ss(model.A, np.reshape(model.B, (2, 1)), [model.C], 0.0),
        sampling_Hz=reel.sampling_Hz,
    )
    chirp = ChirpProfile(0.0, 20.0, 1.0, 40.0, 1.0, loop="open")
    expected = plants.simulate(plant, GAINS, chirp).tension_N
    assert angle(reel, chirp) == pytest.approx(expected, abs=1e-10)


@pytest.mark.usefixtures("interpreted")
def test_unloaded_reel_rejects_effects_of_a_cable():
    for effect in EFFECTS.values():
        loaded = effect.resists or not effect.by_tension  # a gear passes its load on
        if effect.port in (Port.ACTUATOR, Port.DRUM) and loaded:
            assert np.isfinite(angle(plants.unloaded_reel() + effect())).all()
        else:
            with pytest.raises(PlantError, match="without a cable"):
                plants.unloaded_reel() + effect()


def test_unloaded_reel_effects_act_as_on_a_reel():
    late = FINE + DeadTime(1.4 / 632.0)
    assert angle(late) == pytest.approx(angle(replace(FINE, dead_time_s=2.4 / 632.0)), abs=1e-12)
    smooth, rough = angle(FINE), angle(FINE + TorqueRipple(0.02, 8.0, 0.0))
    turns = smooth[-1] * 8.0 / (2.0 * math.pi)
    assert turns > 3.0  # the wave has passed more than once
    assert 0.01 < np.abs(rough - smooth).max() < 1.0


@pytest.mark.parametrize("wrong", [{"drum_inertia_kg_m2": 0.0}, {"sampling_Hz": math.nan}])
def test_unloaded_reel_rejects_values_out_of_range(wrong):
    (name,) = wrong
    with pytest.raises(InvalidInput, match=name):
        plants.unloaded_reel(**wrong)


def test_unloaded_reel_names_unknown_attributes():
    with pytest.raises(InvalidInput, match="cable_EA_N"):
        plants.unloaded_reel(cable_EA_N=1.0)


OF_DRIVES = [name for name, effect in EFFECTS.items() if effect.without_cable]


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("name", OF_DRIVES)
def test_free_run_of_a_drive_with_true_parameters_equals_the_simulation(name):
    one = EFFECTS[name]()
    records = [
        MeasuredRecord.of((FINE + one).rig(seed=0).run(TrialRequest("run", n, GAINS, profile)))
        for n, profile in enumerate((PUSH, replace(PUSH, step_N=-6.0, duration_s=0.9)))
    ]
    quiet = NoiseFloor({"angle_rad": Noise(1e-5, 0.0, "quiet stretches")})
    predictor = Predictor(diagnosed(FINE, records), [type(one)], records, None, quiet)
    zeros = {f.name: 0.0 for f in predictor.free if f.name.startswith("encoder_zero")}
    row = predictor.row(zeros | {f"{name}.{n}": getattr(one, n) for n in one.parameters()})
    bare = predictor.row(zeros | {f"{name}.{n}": getattr(one.neutral(), n) for n in vars(one)})
    for n, record in enumerate(records):
        true, without = (predictor.predict(v[None])[n].angle_rad[0] for v in (row, bare))
        assert true == pytest.approx(record.angle_rad, abs=1e-9)
        assert np.abs(without - record.angle_rad).max() > 1e-4
