import threading
import time

import control
import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.interop import margins
from estune.trial import SATURATED, Outcome, TrialRequest
from estune.trial.profiles import StaircaseProfile, StepProfile

GAINS = Gains(1.0, 40.0, 0.015, 0.005)
STEP = StepProfile(15.0, 10.0, 0.2, 1.0)


def ask(number=0, gains=GAINS, profile=STEP, run="run", attempt=0):
    return TrialRequest(run, number, gains, profile, attempt)


def columns(record):
    names = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
    return [getattr(record, name) for name in names]


def test_record_describes_its_trial():
    rig = plants.reference_reel().rig(name="left", seed=3)
    record = rig.run(ask(4))
    assert (record.trial_id, record.rig, record.outcome) == ("run-00004", "left", Outcome.DONE)
    assert (record.gains, record.preload_N, record.cable_length_m) == (GAINS, 15.0, 0.8)
    assert {len(column) for column in columns(record)} == {632}
    assert np.array_equal(record.setpoint_N, STEP.setpoint(632.0))
    assert record.time_s[-1] == pytest.approx(631 / 632)
    assert record.tension_N[-60:].mean() == pytest.approx(25.0, abs=0.1)
    assert record.current_A[-60:].mean() == pytest.approx(25.0 / 20.0, abs=0.02)
    assert np.std(record.tension_N[:60]) == pytest.approx(0.04, rel=0.3)


def test_rig_noise_depends_only_on_seed_and_trial_number():
    a, b, c = (plants.reference_reel().rig(seed=seed) for seed in (1, 1, 2))
    a.run(ask(0))
    once = a.run(ask(7)).tension_N
    assert np.array_equal(once, b.run(ask(7, run="other", attempt=2)).tension_N)
    assert not np.array_equal(once, c.run(ask(7)).tension_N)
    assert not np.array_equal(once, a.run(ask(8)).tension_N)


def test_repeated_request_returns_the_first_record():
    rig = plants.reference_reel().rig()
    first = rig.run(ask())
    assert rig.run(ask()) is first
    with pytest.raises(RigError, match="run-00000 has run with other gains"):
        rig.run(ask(gains=Gains(2.0, 40.0, 0.015, 0.005)))
    assert rig.run(ask(attempt=1)).trial_id == "run-00000.1"


def test_records_are_read_only():
    record = plants.reference_reel().rig().run(ask())
    for column in columns(record):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1.0


def test_number_of_stored_records_is_bounded():
    rig = plants.reference_reel().rig()
    first = rig.run(ask())
    for number in range(1, 300):
        rig.run(ask(number))
    again = rig.run(ask())
    assert again is not first
    assert np.array_equal(again.tension_N, first.tension_N)


def test_divergence_is_an_outcome():
    plant = plants.linear_plant(control.tf([1.0], [1.0, -1.0]), 0.0, 20.0)
    rig = plant.rig(gains=Gains(3.0, 1.0, 0.0, 0.0))
    record = rig.run(
        ask(gains=Gains(0.1, 0.0, 0.0, 0.0), profile=StepProfile(0.0, 1.0, 0.5, 40.0))
    )
    assert record.outcome is Outcome.DIVERGED
    assert f"at sample {len(record.time_s)}," in record.reason
    assert all(np.isfinite(column).all() for column in columns(record))


def test_abort_ends_a_paced_trial():
    rig = plants.reference_reel().rig(pace=1.0)
    step = StepProfile(15.0, 10.0, 0.2, 60.0)
    records = []
    trial = threading.Thread(target=lambda: records.append(rig.run(ask(profile=step))))
    trial.start()
    while not rig._running:
        time.sleep(0.001)
    before = rig.describe().gains
    assert rig.abort().gains == before
    trial.join(timeout=30.0)
    (record,) = records
    assert record.outcome is Outcome.CANCELLED
    assert {len(column) for column in columns(record)} == {len(record.time_s)}
    assert len(record.time_s) < step.samples(632.0)
    assert rig.run(ask(profile=step)) is record
    assert rig.run(ask(1, profile=StepProfile(15.0, 10.0, 0.01, 0.02))).outcome is Outcome.DONE


def test_paced_trial_takes_its_duration():
    rig = plants.reference_reel().rig(pace=1.0)
    began = time.monotonic()
    record = rig.run(ask(profile=StepProfile(15.0, 10.0, 0.05, 0.2)))
    assert record.outcome is Outcome.DONE
    assert time.monotonic() - began >= 0.19  # waiting can only be too long, never too short


@pytest.mark.parametrize("length", [0.5, 0.8, 1.1, 1.4])
@pytest.mark.parametrize("tension", [5.0, 15.0, 40.0])
def test_safe_gains_are_stable_over_the_reels_range(length, tension):
    rig = plants.reference_reel(length, tension).rig()
    description = rig.describe()
    loop_margins = margins(description.linear_model, description.gains, description.controller)
    assert loop_margins.gain_margin > 4.0
    assert loop_margins.phase_margin_deg > 45.0
    record = rig.run(ask(gains=description.gains, profile=description.step))
    final = description.step.preload_N + description.step.step_N
    assert record.tension_N[-60:].mean() == pytest.approx(
        final, abs=0.05 * abs(description.step.step_N)
    )
    assert description.settling_time_s < description.step.duration_s - description.step.step_at_s


def test_rig_describes_its_reel():
    reel = plants.reference_reel(1.1, 20.0)
    description = reel.rig(name="right").describe()
    stiffness = 1.0 / (1.0 / 20e3 + 1.1 / 10e3)
    natural = 0.025 * np.sqrt(stiffness / 2e-3)
    assert description.settling_time_s == pytest.approx(2 * np.pi / natural, rel=1e-3)
    assert (description.name, description.cable_length_m, description.newtons_per_ampere) == (
        "right",
        1.1,
        20.0,
    )
    assert description.step == StepProfile(20.0, 10.0, 0.2, 1.0)
    assert description.linear_model.dead_time_s == pytest.approx(1 / 632)
    assert description.software.startswith("estune ")
    with pytest.raises(InvalidInput, match="pace"):
        reel.rig(pace=float("nan"))


@pytest.mark.parametrize("kind", ["linear", "function"])
def test_open_loop_setpoint_is_the_limited_effort(kind):
    rate = 100.0
    system = control.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]])
    settings = {"output_min_N": -1.0, "output_max_N": 1.0}
    pole = np.exp(-2.0 / rate)
    plant = {
        "linear": lambda: plants.linear_plant(system, 0.0, rate, **settings),
        "function": lambda: plants.python_plant(
            lambda y, u, _: (following := pole * y + (1.0 - pole) * u, following),
            0.0,
            sampling_Hz=rate,
            settling_time_s=1.0,
            **settings,
        ),
    }[kind]()
    profile = StaircaseProfile(0.0, 0.8, 2, 0.5, 2.4, 0.1, loop="open")
    rig = plant.rig(gains=Gains(0.1, 1.0, 0.0, 0.0))
    record = rig.run(ask(profile=profile))
    effort = np.minimum(profile.setpoint(rate), 1.0)
    np.testing.assert_array_equal(record.current_A, effort)
    np.testing.assert_array_equal(record.flags == SATURATED, profile.setpoint(rate) > 1.0)
    sampled = control.sample_system(system, 1.0 / rate)
    expected = control.forced_response(sampled, record.time_s, effort).outputs
    assert record.tension_N == pytest.approx(expected, abs=1e-12)
