"""Search space of a gain schedule, and its tuning on reels of several lengths."""

import pytest

from estune.core.cost import default_cost
from estune.core.gains import Gains
from experiments.joint_schedule import ScheduleSpace, tune_jointly
from tests.support_runs import ArithmeticRig

START = Gains(0.5, 10.0, 0.005, 0.02)


def test_schedule_of_a_point_has_the_gains_of_the_point():
    space = ScheduleSpace.over(START, (0.5, 1.4))
    point = (0.6, 20.0, 8.0, 0.01, 0.003)
    schedule = space.schedule(point, 15.0)
    for length in (0.5, 0.8, 1.4):
        gains = schedule.gains(length, 15.0).as_tuple()
        assert gains == pytest.approx(space.gains_at(point, length).as_tuple(), rel=1e-12)
    assert pytest.approx(14.0) == space.gains(point).I


def test_joint_tuning_lowers_the_cost_with_trials_at_every_length():
    rigs = {length: ArithmeticRig(name=f"at-{length}") for length in (0.5, 1.4)}
    cost = default_cost(rigs[0.5].describe().settling_time_s)
    schedule = tune_jointly(rigs, "least_squares_gradient", 80, START, cost)
    first, second = (rig.requests for rig in rigs.values())
    assert len(first) == len(second) == 41
    assert [r.gains.P for r in first] == [r.gains.P for r in second]
    best = ArithmeticRig.best
    assert abs(schedule.gains(1.0, 15.0).P - best.P) < abs(START.P - best.P)
