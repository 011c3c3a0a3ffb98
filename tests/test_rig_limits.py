"""Limits that a rig states: what they refuse, and up to where."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.run.limit_verdict import PEAK_SCATTER, measured_overshoot
from estune.trial import LinearModel, Outcome, RigLimits, TrialRequest
from estune.trial.description import MOTION_MARGIN, UNLIMITED_N
from estune.trial.profiles import LoadStepProfile, StaircaseProfile
from estune.trial.record_checks import EFFORT_ERROR, record_fault
from estune.trial.records import COLUMNS
from tests.support_rigs import description, response
from tests.test_limit_verdict import Claim, RobustnessLimits, plan

LIMITS = RigLimits(5.0, 30.0, 60.0, load_max_N=3.0)
STEP = LoadStepProfile(10.0, 5.0, 0.1, 60.0, load_N=3.0, load_at_s=1.0)
LIMITED = description(
    limits=replace(LIMITS, speed_max_rad_s=10.0, travel_max_rad=3.0),
    controller=ControllerSettings(200.0, 0.002, -100.0, 200.0),
)
GAINS = Gains(1.0, 10.0, 0.005, 0.02)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"preload_N": 5.0, "step_N": 25.0}, ""),
        ({"preload_N": 5.0, "step_N": 25.01}, "setpoint 30.01 is outside"),
        ({"preload_N": 30.0, "step_N": -25.01}, "setpoint 4.99 is outside"),
        ({"load_N": -3.0}, ""),
        ({"load_N": -3.01}, "load step of 3.01, and the rig can make at most 3"),
        ({"duration_s": 60.01}, "trial of 60.01 s is longer"),
    ],
)
def test_profile_is_refused_beyond_a_limit_and_not_at_it(changes, words):
    profile = replace(STEP, **changes)
    if not words:
        LIMITS.check(profile)
        return
    with pytest.raises(InvalidInput, match=words):
        LIMITS.check_each(STEP, profile)


def test_rig_without_loads_refuses_the_least_one():
    with pytest.raises(InvalidInput, match="can make none at all"):
        replace(LIMITS, load_max_N=0.0).check(replace(STEP, load_N=1e-3))


@pytest.mark.parametrize(
    ("where", "name", "said"),
    [
        ("controller", "output_min_N", "control effort"),
        ("controller", "output_max_N", "control effort"),
        ("limits", "tension_min_N", "setpoint"),
        ("limits", "tension_max_N", "setpoint"),
        ("limits", "speed_max_rad_s", "speed"),
        ("limits", "travel_max_rad", "travel"),
    ],
)
def test_rig_is_limited_where_each_of_its_limits_is_below_no_limit(where, name, said):
    unlimited = -UNLIMITED_N if name.endswith("min_N") else UNLIMITED_N
    for value, missing in ((unlimited, True), (0.999 * unlimited, False)):
        part = replace(getattr(LIMITED, where), **{name: value})
        rig = replace(LIMITED, **{where: part})
        if missing:
            with pytest.raises(InvalidInput, match=f"no limit of its {said}, and .* model file"):
                rig.check_limited()
        else:
            rig.check_limited()
    replace(LIMITED, limits=LIMITS).check_limited()  # a loop that no drive turns has no speed


@pytest.mark.parametrize("field", ["A", "B", "C", "E", "dead_time_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_linear_model_with_a_number_that_is_not_finite_is_refused(field, value):
    plain = {"A": ((-1.0,),), "B": (1.0,), "C": (1.0,)}
    wrong = {"A": ((value,),), "B": (value,), "C": (value,)}.get(field, value)
    with pytest.raises(InvalidInput, match="not finite"):
        LinearModel(**plain | {field: wrong})


def test_motion_in_an_open_loop_is_predicted_with_a_margin():
    """A drive whose angle integrates its current: 2 rad/s an A, held for 3 s."""
    drive = LinearModel(((0.0,),), (2.0,), (1.0,))
    rate = LIMITED.controller.sampling_Hz
    stairs = StaircaseProfile(0.0, 1.0, 1, 3.0, 3.0, loop="open")
    reached = {"speed": 2.0, "travel": 2.0 * (3.0 - 1.0 / rate)}
    for name, field in (("speed", "speed_max_rad_s"), ("travel", "travel_max_rad")):
        allowed = (1.0 + MOTION_MARGIN) * reached[name]
        for limit, refused in ((1.001 * allowed, False), (0.999 * allowed, True)):
            rig = description(limits=replace(LIMITS, **{field: limit}), linear_model=drive)
            if refused:
                with pytest.raises(InvalidInput, match=f"would reach a {name} of"):
                    rig.check_motion(stairs)
                with pytest.raises(InvalidInput, match=f"would reach a {name} of"):
                    rig.check_motion(replace(stairs, step_N=-1.0))
            else:
                rig.check_motion(stairs)
            rig.check_motion(replace(stairs, loop="closed"))
            replace(rig, linear_model=None).check_motion(stairs)


def test_effort_is_scaled_by_the_gain_at_rest_or_else_at_the_settling_time():
    lag = LinearModel(((-4.0, 0.0), (0.0, -1.0)), (1.0, 1.0), (8.0, 0.0), E=0.5)
    integrator = LinearModel(((0.0,),), (3.0,), (-1.0,))
    assert lag.static_gain == pytest.approx(8.0 / 4.0 + 0.5)
    assert lag.gain_at(4.0) == pytest.approx(abs(8.0 / (4.0 + 4.0j) + 0.5))
    assert integrator.static_gain == math.inf
    scales = [
        description(linear_model=model, settling_time_s=0.5).effort_scale
        for model in (lag, integrator, replace(integrator, C=(0.0,)), None)
    ]
    assert scales[:2] == pytest.approx([2.5, 3.0 * 0.5 / (2.0 * math.pi)])
    assert scales[2:] == [None, None]


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("beyond", "is_fault"), [(0.9, False), (1.1, True)])
def test_effort_may_be_rounded_beyond_its_limits_by_a_hundredth_of_their_range(
    side, beyond, is_fault
):
    rig = LIMITED
    low, high = rig.controller.output_min_N, rig.controller.output_max_N
    request = TrialRequest("run", 0, GAINS, rig.step)
    record = response(request)
    current = record.current_A.copy()
    end = low if side < 0.0 else high
    at = end + side * beyond * 0.01 * (high - low)
    current[7] = at / rig.newtons_per_ampere
    fault = record_fault(replace(record, current_A=current), request, rig)
    assert ("effort at sample 7" in fault) is is_fault
    assert bool(fault) is is_fault
    assert EFFORT_ERROR == 0.01


@pytest.mark.parametrize(("samples", "is_fault"), [(-1, True), (0, False), (1, True)])
def test_trial_that_is_done_has_the_samples_asked_for_and_one_cut_short_no_more(samples, is_fault):
    rig = description()
    request = TrialRequest("run", 0, GAINS, rig.step)
    longer = replace(rig.step, duration_s=rig.step.duration_s + 1.0)
    sent = rig.step.samples(rig.controller.sampling_Hz) + samples
    record = response(replace(request, profile=longer))
    names = (*COLUMNS, "flags", *record.optional_columns)
    cut = replace(record, **{name: getattr(record, name)[:sent] for name in names})
    assert bool(record_fault(cut, request, rig)) is is_fault
    stopped = replace(cut, outcome=Outcome.GUARD, reason="guard")
    assert bool(record_fault(stopped, request, rig)) is (samples > 0)


def records_of(step, peaks, noise=0.0):
    """Records of a step whose overshoots are these, with white noise."""
    made, rng = [], np.random.default_rng(4)
    for number, peak in enumerate(peaks):
        record = response(TrialRequest("run", number, GAINS, step))
        tension = record.setpoint_N + noise * rng.standard_normal(record.setpoint_N.size)
        tension[30] = record.setpoint_N[30] + peak * step.step_N
        made.append(replace(record, tension_N=tension))
    return made


@pytest.mark.parametrize("load", [0.0, 0.02])
def test_overshoot_of_repeats_has_the_interval_of_their_mean_and_of_the_load(load):
    """Student's t of three degrees of freedom is 3.182; the mean of four has half the error."""
    peaks = np.array([0.1, 0.12, 0.12, 0.1])
    claim = Claim(None, "", math.nan, load=load)
    made = plan(RobustnessLimits())
    found = measured_overshoot(made, GAINS, records_of(made.step, peaks), claim)
    half = 3.1824 * max(peaks.std(ddof=1), load) / 2.0
    expected = (peaks.mean(), max(peaks.mean() - half - load, 0.0), peaks.mean() + half)
    assert found == pytest.approx(expected, rel=1e-4)


def test_overshoot_of_few_repeats_has_the_interval_of_their_noise():
    made, noise = plan(RobustnessLimits()), 0.05
    made = replace(made, step=replace(made.step, duration_s=30.0))
    found = measured_overshoot(made, GAINS, records_of(made.step, [0.3, 0.3], noise=noise))
    half = 1.96 * PEAK_SCATTER * noise / abs(made.step.step_N) / math.sqrt(2.0)
    assert found.high - found.value == pytest.approx(half, rel=0.04)
    assert found.value - found.low == pytest.approx(half, rel=0.04)
