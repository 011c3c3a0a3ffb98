"""Constraint margin of a trial."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.trial import Outcome, RigLimits, TrialRequest, empty_record
from estune.trial.scoring import constraint_margin
from tests.support_runs import START, ArithmeticRig, description

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
