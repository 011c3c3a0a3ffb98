"""Cost, metrics and constraint margin of a trial."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.metrics import NO_METRICS, step_metrics
from estune.errors import RigError
from estune.trial import Outcome, RigLimits, TrialRecord, TrialRequest, empty_record
from estune.trial.profiles import LoadStepProfile, StepProfile
from estune.trial.scoring import constraint_margin, cost_of, load_metrics_of, metrics_of
from tests.support_runs import START, ArithmeticRig, description
from tests.test_cost import SAMPLES, SHAPE, STEP_INDEX, SAMPLING_Hz, ringing
from tests.test_cost import columns as columns_of

# The step goes from 10 to 20 N; limits 0 to 50 N of tension, -100 to 100 N of effort, 20 N/A.
RIG = description()


def record(**columns):
    record = ArithmeticRig().run(TrialRequest("run", 0, START, RIG.step))
    flat = {"tension_N": record.setpoint_N, "current_A": record.setpoint_N / 20.0}
    for name, peak in columns.items():
        flat[name] = np.concatenate([flat[name][:-1], [peak]])
    return replace(record, **flat)


@pytest.mark.parametrize(
    ("columns", "share"),
    [
        ({}, 1.0),
        ({"tension_N": 35.0}, 0.5),
        ({"tension_N": 50.0}, 0.0),
        ({"tension_N": 53.0}, -0.1),
        ({"tension_N": 4.0}, 0.4),
        ({"current_A": 60.0 / 20.0}, 0.5),
        ({"current_A": -45.0 / 20.0}, 0.5),
        ({"tension_N": 35.0, "current_A": 92.0 / 20.0}, 0.1),
    ],
)
def test_constraint_margin_is_the_smallest_remaining_share(columns, share):
    assert constraint_margin(record(**columns), RIG) == pytest.approx(share)


@pytest.mark.parametrize(("peak_V", "share"), [(2.0, 1.0), (7.0, 0.5), (12.0, 0.0)])
def test_constraint_margin_of_an_effort_in_another_unit_is_relative_to_its_holding_value(
    peak_V, share
):
    oven = replace(
        RIG,
        controller=replace(RIG.controller, output_min_N=-math.inf, output_max_N=12.0),
        measurement="temperature, K",
        command="voltage, V",
    )
    flat = record()
    effort_V = np.where(flat.setpoint_N > 10.0, 2.0, 1.0)
    effort_V[np.argmax(flat.setpoint_N)] = peak_V
    assert constraint_margin(replace(flat, current_A=effort_V / 20.0), oven) == pytest.approx(
        share
    )


def test_effort_that_holds_the_plant_is_that_of_the_last_tenth_at_either_end():
    """Samples of other efforts before those tenths, and a third setpoint between, do not count."""
    free = replace(RIG.controller, output_min_N=-8.0, output_max_N=12.0)
    oven = replace(RIG, controller=free, measurement="temperature, K", command="voltage, V")
    setpoint = np.repeat([10.0, 15.0, 20.0], 40)
    effort_V = np.concatenate([np.full(36, 2.5), [1.0, 3.0] * 2, np.full(76, 2.5), [3.0, 5.0] * 2])
    flat = record()
    of = {"time_s": np.arange(120) / 100.0, "setpoint_N": setpoint, "tension_N": setpoint}
    at_rest = replace(flat, **of, current_A=effort_V / 20.0)
    assert constraint_margin(at_rest, oven) == pytest.approx((12.0 - 5.0) / (12.0 - 4.0))
    effort_V[50] = -3.0
    low = replace(at_rest, current_A=effort_V / 20.0)
    assert constraint_margin(low, oven) == pytest.approx((-3.0 + 8.0) / (2.0 + 8.0))
    still = replace(low, setpoint_N=np.full(120, 20.0), tension_N=np.full(120, 20.0))
    assert constraint_margin(still, oven) == pytest.approx((-3.0 + 8.0) / (3.0 + 8.0))


def test_effort_that_holds_the_plant_may_be_of_one_sample():
    oven = replace(RIG, measurement="temperature, K", command="voltage, V")
    held = {"time_s": np.arange(4) / 100.0, "setpoint_N": np.array([10.0, 10.0, 20.0, 20.0])}
    effort_V = np.array([1.0, 2.0, 3.0, 4.0]) / 20.0
    few = replace(record(), **held, tension_N=held["setpoint_N"], current_A=effort_V)
    assert constraint_margin(few, oven) == pytest.approx((1.0 + 100.0) / (2.0 + 100.0))


def test_measurement_that_is_no_number_leaves_the_margin_of_the_effort():
    lost = record(tension_N=math.nan, current_A=60.0 / 20.0)
    assert constraint_margin(lost, RIG) == pytest.approx(0.5)


def test_constraint_margin_ignores_unlimited_sides():
    tight = replace(RIG, limits=RigLimits(10.0, 20.0, 5.0))
    assert constraint_margin(record(tension_N=25.0), tight) == pytest.approx(1.0)
    free = replace(
        RIG,
        limits=RigLimits(-math.inf, math.inf, 5.0),
        controller=replace(RIG.controller, output_min_N=-math.inf, output_max_N=math.inf),
    )
    assert constraint_margin(record(tension_N=1e9), free) == math.inf


def test_constraint_margin_without_samples_is_infinite():
    request = TrialRequest("run", 0, START, RIG.step)
    nothing = empty_record(request, RIG, Outcome.CANCELLED, "stopped", "2009-05-04T12:00:00+00:00")
    assert constraint_margin(nothing, RIG) == math.inf


STEP = StepProfile(10.0, 5.0, STEP_INDEX / SAMPLING_Hz, 1.0)


def ringing_record(outcome=Outcome.DONE, samples=SAMPLES, **changed):
    setpoint, measurement, effort = (column[:samples] for column in columns_of(ringing))
    parts = {
        "time_s": np.arange(samples) / SAMPLING_Hz,
        "setpoint_N": setpoint,
        "tension_N": measurement,
        "current_A": effort / 20.0,
        "angle_rad": np.zeros(samples),
        "flags": np.zeros(samples, np.uint8),
        **changed,
    }
    return TrialRecord(
        *("run-00000", "bench", SAMPLING_Hz, None, 10.0, Gains(1.0, 1.0, 0.0, 0.0)),
        *(outcome, "", "2026-01-01T00:00:00+00:00", "test"),
        **parts,
    )


def test_record_is_scored_by_tension_and_effort():
    cost = StepCost(0.3, move_weight=0.2)
    setpoint, measurement, effort = columns_of(ringing)
    assert cost_of(ringing_record(), STEP, cost, newtons_per_ampere=20.0) == pytest.approx(
        cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurement, effort)
    )
    metrics = metrics_of(ringing_record(), STEP)
    assert metrics == step_metrics(
        np.arange(SAMPLES) / SAMPLING_Hz,
        measurement,
        step_time_s=STEP_INDEX / SAMPLING_Hz,
        initial=10.0,
        final=15.0,
    )
    assert all(map(math.isfinite, metrics))


def test_metrics_of_a_trial_with_a_load_are_those_before_it_and_after_it():
    plain = ringing_record()
    loaded = LoadStepProfile(10.0, 5.0, STEP.step_at_s, 2.0, load_N=3.0, load_at_s=1.0)
    lag = np.exp(-np.arange(SAMPLES) / 50.0)
    both = {
        name: np.concatenate([getattr(plain, name), getattr(plain, name)[-1] + change])
        for name, change in (
            ("time_s", np.arange(1, SAMPLES + 1) / SAMPLING_Hz),
            ("setpoint_N", 0.0 * lag),
            ("tension_N", 2.0 * lag),
            ("current_A", 0.0 * lag),
        )
    }
    trial = replace(plain, **both)
    assert metrics_of(trial, loaded) == metrics_of(plain, STEP)
    assert load_metrics_of(plain, STEP) is None
    assert load_metrics_of(replace(trial, outcome=Outcome.GUARD), loaded) is None
    found = load_metrics_of(trial, loaded)
    assert found.peak == pytest.approx(2.0, abs=5e-3)
    within = np.log(2.0 / (0.02 * 5.0)) * 50.0 / SAMPLING_Hz
    assert found.recovery_time_s == pytest.approx(within, abs=1.0 / SAMPLING_Hz)


def with_sample(value, index):
    column = np.full(SAMPLES, 12.0)
    column[index] = value
    return column


@pytest.mark.parametrize(
    "unscorable",
    [
        *(ringing_record(outcome) for outcome in Outcome if outcome is not Outcome.DONE),
        ringing_record(Outcome.GUARD, samples=150),
        ringing_record(Outcome.CANCELLED, samples=0),
        ringing_record(tension_N=with_sample(math.nan, 300)),
        ringing_record(tension_N=with_sample(math.inf, 3)),
        ringing_record(current_A=with_sample(math.nan, 631)),
    ],
    ids=lambda r: f"{r.outcome} {r.time_s.size}",
)
def test_aborted_or_non_finite_record_has_no_metrics(unscorable):
    assert math.isnan(cost_of(unscorable, STEP, StepCost(0.3), 20.0))
    assert list(map(math.isnan, metrics_of(unscorable, STEP))) == [True] * len(NO_METRICS)


def test_record_too_large_to_square_has_no_cost():
    huge = ringing_record(tension_N=with_sample(1e200, 300))
    assert math.isnan(cost_of(huge, STEP, StepCost(0.3), 20.0))


def test_record_of_unexpected_length_is_refused():
    with pytest.raises(RigError, match="600 samples of time_s instead of 632"):
        cost_of(ringing_record(samples=600), STEP, StepCost(0.3), 20.0)
