"""A ramp to the setpoint: its samples, its reference in the cost, and trials with it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.signal import lsim

import estune
import plants
from estune.core.cost import StepCost
from estune.core.response import StepShape
from estune.errors import InvalidInput
from estune.remote.messages import digest, encode
from estune.remote.messages.commands import Submit
from estune.run.planning import step_trial
from estune.run.toml_tables import StepTable
from estune.trial import TrialRequest
from estune.trial.profiles import LoadStepProfile, Profile, StepProfile

RATE_HZ = 500.0
STEP = StepProfile(15.0, -4.0, 0.2, 1.0)
RAMP = replace(STEP, ramp_s=0.25)


def test_ramp_moves_in_equal_parts_and_a_step_at_once():
    setpoint = RAMP.setpoint(RATE_HZ)
    moves = np.diff(setpoint)
    assert np.flatnonzero(moves).tolist() == list(range(99, 99 + 125))
    assert moves[99 : 99 + 125] == pytest.approx(-4.0 / 125)
    assert setpoint[-1] == 11.0
    assert np.flatnonzero(np.diff(STEP.setpoint(RATE_HZ))).tolist() == [99]


@pytest.mark.parametrize("criterion", ["paper", "itae", "ise"])
def test_first_order_system_on_the_ramp_costs_one(criterion):
    t, t_s = np.arange(2000) / 2000.0, 0.3
    r = np.clip(t / 0.2, 0.0, 1.0)
    _, y, _ = lsim(([1.0], [t_s / 4.0, 1.0]), r, t)  # independent: in continuous time
    cost, shape = StepCost(t_s, criterion=criterion), StepShape(0, 1.0, ramp=400)
    assert cost.evaluate(2000.0, shape, r, y, y) == pytest.approx(1.0, rel=0.01)


def test_message_has_the_ramp_only_where_there_is_one():
    gains = plants.reference_reel().rig().describe().gains
    shown = {}
    for name, profile in (("step", STEP), ("ramp", RAMP)):
        request = TrialRequest("run", 1, gains, profile)
        message = Submit("5ad1e7c0ffee0042", request, digest(request))
        shown[name] = json.loads(encode(message))["request"]["profile"]
        assert TypeAdapter(Profile).validate_python(shown[name]) == profile
    assert shown["ramp"] == {**shown["step"], "ramp_s": 0.25}
    assert digest(TrialRequest("run", 1, gains, RAMP)) != digest(
        TrialRequest("run", 1, gains, STEP)
    )


def test_prediction_of_a_ramp_is_that_of_its_setpoint():
    about = plants.reference_reel().rig().describe()
    step = StepTable(ramp_s=0.2).of(about)
    trial = step_trial(about, step, StepCost(about.settling_time_s))
    rate = about.controller.sampling_Hz
    assert step.preload_N + trial.setpoint == pytest.approx(step.setpoint(rate))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: replace(RAMP, ramp_s=-0.1),
        lambda: replace(RAMP, ramp_s=0.9),
        lambda: LoadStepProfile(15.0, 4.0, 0.2, 2.0, ramp_s=0.5, load_N=1.0, load_at_s=0.6),
    ],
)
def test_ramp_that_does_not_fit_is_refused(wrong):
    with pytest.raises(InvalidInput, match=r"ramp|load at 0.6 s must come after the step at 0.7"):
        wrong()


def test_reel_is_tuned_by_ramps(tmp_path):
    reel = plants.reference_reel()
    step = replace(reel.rig().describe().step, ramp_s=0.1)
    result = estune.tune(reel, step=step, trials=30, folder=tmp_path, run="ramp", watch=None)
    assert result.success
    again = estune.load(tmp_path / "ramp")
    assert again.plan.step.ramp_s == 0.1
    assert again.rig.step_text(step).endswith("N (ramp_s 0.1)")
