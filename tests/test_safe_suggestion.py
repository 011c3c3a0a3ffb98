"""Gains recommended from logs: never from what the log does not show, nor by an absurd cost."""

from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.loop_model.intervals import Interval, relative_cost
from estune.loop_model.optimum import RobustnessLimits
from estune.recordings.loop_log import LoopLog
from estune.service_records.suggestion import is_worthwhile, suggest

GAINS = Gains(1.6, 0.75, 0.0, 0.0)


def loop_log(
    setpoint: np.ndarray, gains: Gains = GAINS, *, load: float = 0.0, noise: float = 0.01
) -> LoopLog:
    """1.5/(2s+1) e^-0.3s at 10 Hz under PI from rest; the load is an AR(1) of this innovation."""
    rng, pole, delayed = np.random.default_rng(9), np.exp(-0.05), [0.0] * 3
    state = sums = drift = 0.0
    rows = []
    for r in setpoint:
        measured = state + noise * rng.standard_normal()
        effort = gains.P * (r - measured) + sums
        sums += 0.1 * gains.I * (r - measured)
        rows.append((r, measured, effort))
        drift = 0.99 * drift + load * rng.standard_normal()
        delayed.append(effort)
        state = pole * state + 1.5 * (1.0 - pole) * (delayed.pop(0) + drift)
    columns = dict(zip(("setpoint", "measurement", "effort"), np.array(rows).T, strict=True))
    columns["time"] = 0.1 * np.arange(setpoint.size)
    return LoopLog("loop.csv", 10.0, (columns,), gains, {}, {}, ())


def servo_log(gains: Gains) -> LoopLog:
    """A position loop of 1 kHz, 0.1/(2e-4 s^2 + 1e-3 s), that is stepped every 0.5 s."""
    rng, h, x, v, sums, last, delayed = np.random.default_rng(5), 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0
    setpoint = 0.5 * (np.arange(2500) // 500 % 4)
    derivative, rows = 0.0, []
    for r in setpoint:
        y = x + 1e-5 * rng.standard_normal()
        derivative = (5e-4 * derivative + y - last) / (5e-4 + h)
        effort = gains.P * (r - y) + sums - gains.D * derivative
        sums, last = sums + h * gains.I * (r - y), y
        rows.append((r, y, effort))
        v, x = v + h * (500.0 * delayed - 5.0 * v), x + h * v
        delayed = effort
    columns = dict(zip(("setpoint", "measurement", "effort"), np.array(rows).T, strict=True))
    columns["time"] = h * np.arange(setpoint.size)
    return LoopLog("servo.csv", 1000.0, (columns,), gains, {}, {}, ())


def test_a_start_under_a_load_that_drifts_recommends_nothing():
    found = suggest([loop_log(np.ones(3000), load=0.009)])

    assert found.verdict == "cannot tell"
    assert "setpoint moves once" in found.heading()


def test_effort_of_an_integrating_plant_is_weighed_by_its_gain_within_the_settling_time():
    found = suggest([servo_log(Gains(8.0, 40.0, 0.12, 0.0))], derivative_filter_s=5e-4)

    assert found.margins.cost.value < 30.0
    assert found.recommendation.gains.P > 4.0


@pytest.fixture(scope="module")
def stepped():
    """What is said of a loop that is stepped every 20 s."""
    return suggest([loop_log(np.random.default_rng(3).uniform(-2.0, 2.0, 5).repeat(200))])


def test_costs_of_two_sets_of_gains_are_compared_by_the_same_models(stepped):
    same = relative_cost(stepped.fit, stepped.trial, GAINS, GAINS)

    assert same == pytest.approx((1.0, 1.0, 1.0))


def test_gains_that_may_cost_more_than_those_in_use_are_not_recommended(stepped):
    better, limits = stepped.recommendation, RobustnessLimits()
    surely, perhaps = (
        better._replace(relative_cost=Interval(0.4, 0.3, high)) for high in (0.9, 1.2)
    )

    assert is_worthwhile(stepped.margins, surely, limits)
    assert not is_worthwhile(stepped.margins, perhaps, limits)
    kept = replace(stepped, verdict="keep", recommendation=perhaps).heading()
    assert "by -60%, but by up to +20%" in kept


def test_a_load_that_is_rejected_much_worse_is_in_the_first_line(stepped):
    slower = stepped.recommendation._replace(load_error=13.0)

    first = replace(stepped, verdict="change", recommendation=slower).heading()

    assert "the error after a load is 13 times as large" in first
    assert ("error after a load, in use = 1", "1", "13") in replace(
        stepped, recommendation=slower
    ).rows()


def test_a_step_from_a_rest_that_shows_the_load_is_told():
    Ms = suggest([loop_log(np.repeat([0.0, 1.0], 1500), load=0.009)]).margins.sensitivity

    assert Ms.low <= 1.45 <= Ms.high
