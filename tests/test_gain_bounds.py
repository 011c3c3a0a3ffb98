"""Bounds of live gains and of those of a trial, at every way by which gains reach a rig."""

import json
import math
from dataclasses import replace

import control
import pytest

import estune
import plants
from estune.cli.checks.check_result import State
from estune.cli.checks.description_checks import check_gain_bounds
from estune.core.gains import Gains
from estune.core.schedule import GainCurve, GainSchedule
from estune.errors import InvalidInput
from estune.hardware.config import config_from
from estune.remote.ledger import MemoryLedger
from estune.remote.messages import digest, encode
from estune.remote.messages.commands import Lease, SetGains, Submit
from estune.remote.messages.replies import Description
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.request_handler import RequestHandler
from estune.run.planning import make_tuner
from estune.trial import Outcome, RigLimits, TrialRequest
from estune.trial.gain_bounds import UNBOUNDED, GainBounds
from experiments.virtual_loop import virtual_rig
from tests.support_hardware import config, tables
from tests.support_rigs import ScriptedRig, description

HUGE = 1e19
STATED = {"gain_bounds": {"live": {"P": [0.1, 2.0]}, "trial": {"P": [0.05, 5.0]}}}


def request(about, gains, number=0):
    return TrialRequest("bounds", number, gains, replace(about.step, duration_s=0.5))


def bounded_rig():
    made = config(driver__settings={"seed": 1}, **STATED)
    return virtual_rig(made)


def simulated_rig():
    return plants.reference_reel().rig()


@pytest.mark.parametrize("make", [simulated_rig, bounded_rig], ids=lambda make: make.__name__)
def test_rig_refuses_gains_out_of_bounds_as_live_ones_and_in_a_trial(make):
    rig = make()
    about = rig.describe()
    for field in ("P", "I", "D", "setpoint_filter_s"):
        gains = replace(about.gains, **{field: HUGE})
        with pytest.raises(InvalidInput, match=rf"gain {field} 1e\+19 .* of live gains"):
            rig.apply(gains)
        with pytest.raises(InvalidInput, match=rf"gain {field} 1e\+19 .* of a trial's gains"):
            rig.run(request(about, gains))
    assert rig.describe().gains == about.gains
    assert rig.run(request(about, about.gains, 1)).outcome is Outcome.DONE
    rig.close()


def test_bounds_of_the_file_hold_each_for_its_own_gains():
    with bounded_rig() as rig:
        about = rig.describe()
        trial = replace(about.gains, P=3.0)
        with pytest.raises(InvalidInput, match=r"P 3 is outside .* live gains, 0.1 to 2"):
            rig.apply(trial)
        assert rig.run(request(about, trial)).outcome is not None
        for P, call in ((0.09, rig.apply), (6.0, lambda gains: rig.run(request(about, gains, 2)))):
            with pytest.raises(InvalidInput, match="choose others"):
                call(replace(about.gains, P=P))
        rig.apply(replace(about.gains, P=2.0))
        assert rig.describe().gains.P == 2.0


def test_default_takes_one_step_a_hundred_times_over_the_greatest_effort():
    about = plants.reference_reel().rig().describe()
    controller, step = about.controller, about.step.step_N
    bounds = dict(about.bounds_of(trial=False).items())
    most = 100.0 * max(abs(controller.output_min_N), abs(controller.output_max_N))
    assert bounds["P"][1] * step == pytest.approx(most)
    assert bounds["I"][1] * step * about.settling_time_s == pytest.approx(most, rel=1e-5)
    lag_s = controller.derivative_filter_s + 1.0 / controller.sampling_Hz
    assert bounds["D"][1] * step / lag_s == pytest.approx(most, rel=1e-5)
    assert bounds["setpoint_filter_s"] == (0.0, about.limits.duration_max_s)
    wide = dict(about.bounds_of(trial=True).items())
    assert wide["P"][1] == pytest.approx(100.0 * bounds["P"][1])


def test_rig_without_a_limit_of_its_effort_has_no_bounds_of_its_own():
    about = description()
    assert about.controller.output_max_N == math.inf
    assert about.bounds_of(trial=False) == about.bounds_of(trial=True) == UNBOUNDED
    assert check_gain_bounds(about).state is State.UNKNOWN


def test_plant_of_other_units_is_tuned_within_its_bounds():
    system = control.tf([1.0], [20.0, 1.0])
    oven = plants.linear_plant(system, dead_time_s=5.0, output_min_N=0.0, output_max_N=10.0)
    result = estune.tune(oven, trials=5, journal=False, watch=None)
    oven.rig().describe().check_gains(result.gains)


def test_server_refuses_for_a_rig_that_does_not_check_itself():
    rig = ScriptedRig(controller=replace(description().controller, output_max_N=100.0))
    handler = RequestHandler(rig, MemoryLedger(), lambda: None, instance="0f")
    handler.lease(Lease("acquire", "mine", "me"))
    gains = rig.describe().gains
    wild = replace(gains, P=HUGE)
    for command in (SetGains("mine", wild), SetGains("mine", gains, original=wild)):
        answer = handler.gains(command)
        assert answer.verdict is ReplyCode.REFUSED
        assert "gain P 1e+19" in answer.sentence
    asked = request(rig.describe(), wild)
    answer = handler.submit(Submit("mine", asked, digest(asked))).answer
    assert answer.verdict is ReplyCode.REFUSED
    assert "a trial's gains" in answer.sentence
    assert rig.describe().gains == gains
    handler.close()


def test_file_whose_own_gains_are_out_of_bounds_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match=r"gain I 50 is outside .* 0 to 20"):
        config(gains__I=50.0, gain_bounds={"live": {"I": [0.0, 20.0]}})
    with pytest.raises(InvalidInput, match="in order"):
        config(gain_bounds={"live": {"I": [20.0, 0.0]}})
    constant = (GainCurve("constant", value) for value in (0.01, 0.03))
    linear = GainCurve("linear", 0.0, 30.0)
    schedule = GainSchedule(
        GainCurve("constant", 0.4), linear, *constant, length_m=(0.5, 2.0), tension_N=(5.0, 40.0)
    )
    path = tmp_path / "law.json"
    path.write_text(json.dumps(schedule.as_dict()))
    scheduled = {"schedule": {"file": str(path)}, "gains": None}
    made = {key: value for key, value in (tables() | scheduled).items() if value is not None}
    gains = config_from(made, "rig.toml").describe().gains
    assert pytest.approx(24.0) == gains.I
    with pytest.raises(InvalidInput, match=r"gain I 60 is outside .* 0 to 50"):
        config_from(made | {"gain_bounds": {"live": {"I": [0.0, 50.0]}}}, "rig.toml")


def test_search_stays_within_the_bounds_of_a_trial():
    start = Gains(0.4, 12.0, 0.01, 0.03)
    tuner = make_tuner("model_based", start, None, GainBounds(P=(0.1, 3.0)))
    space = tuner.space
    ends = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
    assert ends["P"] == (0.1, 3.0)
    with pytest.raises(InvalidInput, match=r"starts at P 0.4, outside the rig's bounds"):
        make_tuner("model_based", start, None, GainBounds(P=(0.5, 3.0)))


def test_description_states_bounds_of_the_file_alone():
    plain = encode(Description(description(), "0f", "ledger"))
    assert b"bounds" not in plain
    stated = replace(description(), live_bounds=GainBounds(P=(0.1, 2.0)))
    told = json.loads(encode(Description(stated, "0f", "ledger")))["rig"]
    assert told["live_bounds"]["P"] == [0.1, 2.0]
    assert told["live_bounds"]["I"] == [0.0, None]
    assert stated.bounds_of(trial=False).P == (0.1, 2.0)
    assert stated.bounds_of(trial=False).I == description().bounds_of(trial=False).I


@pytest.mark.parametrize(
    "limits", [(0.0, 10.0, 0.0), (0.0, 10.0, math.nan), (0.0, 10.0, 5.0, -1.0), (10.0, 0.0, 5.0)]
)
def test_limits_that_no_trial_can_keep_are_refused(limits):
    with pytest.raises(InvalidInput):
        RigLimits(*limits)
