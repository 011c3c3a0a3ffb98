"""Limits that a rig states: what they refuse, and up to where."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.loop_model.intervals import Interval, PredictedMargins
from estune.run.limit_verdict import LimitState, limit_verdict, measured_overshoot
from estune.trial import LinearModel, Outcome, RigLimits, TrialRequest
from estune.trial.profiles import LoadStepProfile, StaircaseProfile
from estune.trial.record_checks import EFFORT_ERROR, record_fault
from estune.trial.records import COLUMNS
from estune.trial.scoring import metrics_of
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
    unlimited = -1e9 if name.endswith("min_N") else 1e9  # as in files of rigs
    for value, missing in ((unlimited, True), (0.999 * unlimited, False)):
        part = replace(getattr(LIMITED, where), **{name: value})
        rig = replace(LIMITED, **{where: part})
        if missing:
            with pytest.raises(InvalidInput, match=f"no limit of its {said}, and .* model file"):
                rig.check_limited()
        else:
            rig.check_limited()
    replace(LIMITED, limits=LIMITS).check_limited()  # a loop that no drive turns has no speed


@pytest.mark.parametrize(("loop", "table"), [("open", "drive"), ("closed", "plant")])
def test_rig_without_a_limit_is_told_the_table_for_it(loop, table):
    limits = replace(LIMITED.limits, tension_max_N=math.inf)
    rig = replace(LIMITED, limits=limits, step=replace(LIMITED.step, loop=loop))
    with pytest.raises(InvalidInput, match=f"to the table of the {table} in its model file"):
        rig.check_limited()


@pytest.mark.parametrize("name", ["newtons_per_ampere", "settling_time_s", "cable_length_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_rig_described_by_a_number_that_is_not_above_zero_and_finite_is_refused(name, value):
    with pytest.raises(InvalidInput, match=f"{name} is {value}; it must be above zero"):
        description(**{name: value})


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
        allowed = 1.25 * reached[name]
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


def test_travel_is_the_way_from_where_a_trial_begins():
    """Down for a second, then up again for less; a measurement that follows the current, too."""
    drive = LinearModel(((0.0,),), (2.0,), (1.0,), E=0.5)
    stairs = StaircaseProfile(-3.0, 2.0, 2, 1.0, 1.75, loop="open")
    reached = 1.25 * 2.0 * (1.0 - 1.0 / LIMITED.controller.sampling_Hz)
    near, far = (
        description(limits=replace(LIMITS, travel_max_rad=share * reached), linear_model=drive)
        for share in (0.999, 1.001)
    )
    far.check_motion(stairs)
    with pytest.raises(InvalidInput, match="would reach a travel of"):
        near.check_motion(stairs)


def test_plant_is_an_integrator_where_only_rounding_limits_its_gain_and_may_have_no_state():
    for gain, shown in ((0.9e12, 0.9e12), (1.1e12, math.inf)):
        assert LinearModel(((-1.0,),), (gain,), (1.0,)).static_gain == pytest.approx(shown)
    assert LinearModel((), (), (), E=-2.5).static_gain == 2.5


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


@pytest.mark.parametrize(("periods", "is_fault"), [(0.0, True), (9.9, False), (10.1, True)])
def test_clock_may_stand_for_no_sample_and_leap_over_less_than_ten(periods, is_fault):
    rig = description()
    request = TrialRequest("run", 0, GAINS, rig.step)
    record = response(request)
    later = (periods - 1.0) / record.sampling_Hz * (np.arange(record.time_s.size) > 7)
    fault = record_fault(replace(record, time_s=record.time_s + later), request, rig)
    assert ("at sample 8" in fault) is is_fault
    assert bool(fault) is is_fault


def test_void_trial_has_no_other_fault_than_to_be_another_trial():
    rig = description()
    request = TrialRequest("run", 0, GAINS, rig.step)
    void = replace(response(request), outcome=Outcome.CANCELLED, started_at="yesterday")
    assert not record_fault(void, request, rig)
    assert "stale" in record_fault(void, replace(request, number=1), rig)


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
    half = 1.96 * 0.7 * noise / abs(made.step.step_N) / math.sqrt(2.0)
    assert found.high - found.value == pytest.approx(half, rel=0.04)
    assert found.value - found.low == pytest.approx(half, rel=0.04)


def test_overshoot_is_that_of_its_rule_whatever_is_claimed_and_however_many_repeats_there_are():
    """Peaks are random, every third record has none, claims say more or less than they."""
    made, random, seen = plan(RobustnessLimits()), np.random.default_rng(5), set()
    unknown = Interval(math.nan, 0.0, math.inf)
    for count in np.arange(48) % 8:
        noise = random.uniform(0.0, 0.2)
        records = records_of(made.step, random.uniform(0.02, 0.2, count), noise=noise)
        records[2::3] = (replace(one, outcome=Outcome.GUARD) for one in records[2::3])
        safe = [one for one in records if one.outcome is Outcome.DONE]
        others = [replace(one, gains=replace(GAINS, P=9.0)) for one in records[:1]]
        told = Interval(0.1, *np.sort(random.uniform(0.0, 0.2, 2)).tolist())
        told = (told, told._replace(high=math.inf), None)[random.choice(3, p=[0.8, 0.1, 0.1])]
        margins = told and PredictedMargins(unknown, told, unknown, unknown)
        load, is_white = random.uniform(0.0, 0.02), bool(random.integers(2))
        claim = Claim(margins, "", 0.0, is_white, load=load) if random.random() < 0.8 else None
        found = measured_overshoot(made, GAINS, [*others, *records], claim)
        if not count:
            assert found is None
            continue
        peaks = [metrics_of(one, made.step).overshoot for one in safe]
        if len(peaks) < 4:
            moves = np.concatenate([np.diff(one.tension_N) for one in safe])
            quartile = stats.norm.ppf(0.75) * math.sqrt(2.0)
            spread = 0.7 * np.median(np.abs(moves)) / quartile / abs(made.step.step_N)
            wide = stats.norm.ppf(0.975)
        else:
            spread, wide = np.std(peaks, ddof=1), stats.t.ppf(0.975, len(peaks) - 1)
        load = claim.load if claim else 0.0
        half = wide * max(spread, load) / math.sqrt(len(peaks))
        low, high = max(np.mean(peaks) - half - load, 0.0), np.mean(peaks) + half
        expected = Interval(np.mean(peaks), low, high)
        if claim and claim.margins and claim.margins.overshoot.high < math.inf:
            agree = max(low, told.low) <= min(high, told.high)
            both = Interval(np.mean(peaks), min(low, told.low), max(high, told.high))
            expected = told if agree and is_white else both
            seen.add((agree, is_white))
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert len(seen) == 4


BADNESS = [LimitState.KEPT, LimitState.NOT_SHOWN, LimitState.BROKEN]
TOLD = ((1.4, 0.01), (40.0, 1.0))
"""Ms and phase margin, with the half of their intervals."""


def test_verdict_is_that_of_the_worst_limit_and_its_reason_names_each_that_is_as_bad():
    made, random, seen = plan(RobustnessLimits()), np.random.default_rng(6), set()
    records = records_of(made.step, [0.04, 0.05, 0.04, 0.05])
    shown = measured_overshoot(made, GAINS, records)
    for _ in range(120):
        limits = random.uniform([1.38, 38.0, 0.03], [1.43, 42.0, 0.06]).tolist()
        limits = [one if random.random() < 0.8 else None for one in limits]
        Ms, angle = (Interval(value, value - wide, value + wide) for value, wide in TOLD)
        unknown = Interval(math.nan, 0.0, math.inf)
        margins = PredictedMargins(unknown, unknown, Ms, angle) if random.random() < 0.8 else None
        known = random.random() < 0.8
        judged = {}
        for name, limit, at, sign in (
            ("sensitivity Ms", limits[0], margins and Ms, 1.0),
            ("phase margin", limits[1], margins and angle, -1.0),
            ("overshoot", limits[2], shown if known else None, 1.0),
        ):
            if limit is not None and at is None:
                told = "no record shows" if name == "overshoot" else "no sensitivity is claimed"
                judged[told] = LimitState.NOT_SHOWN
            elif limit is not None:
                beyond = sum(sign * (end - limit) > 0.01 * limit for end in at[1:])
                judged[name] = BADNESS[beyond]
        worst = max(judged.values(), key=BADNESS.index, default=LimitState.KEPT)
        robust = RobustnessLimits(limits[0], limits[2], limits[1])
        judge = replace(made, limits=robust), Claim(margins, "", 0.0), GAINS
        found = limit_verdict(*judge, records if known else ())
        assert found.state is worst
        for name, state in judged.items():
            is_told = state is worst is not LimitState.KEPT
            assert bool(re.search(name, found.reason)) is is_told
        seen.update((name, state) for name, state in judged.items() if state is worst)
    assert len(seen) == 3 * 3 + 1
    assert limit_verdict(replace(made, limits=None), *judge[1:], ()) == (LimitState.KEPT, "")
