"""The gains, filters and changes of gains that a logged effort shows."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.core.controller_equation import unlimited_effort
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.recordings.loop_log import LoopLog
from estune.service_records.gain_sets import gain_sets
from estune.service_records.replay import replay
from estune.service_records.stretches import Stretch

OWN = ControllerSettings(1.0, 2.0, -math.inf, math.inf)
GAINS = Gains(2.0, 0.05, 4.0, 0.0)


def signals(rows: int = 2400) -> tuple[np.ndarray, np.ndarray]:
    """A setpoint of steps and a measurement that follows it with noise."""
    rng = np.random.default_rng(5)
    setpoint = np.repeat(rng.uniform(-1.0, 1.0, 12), rows // 12)
    follows = np.convolve(setpoint, np.full(40, 1 / 40))[: setpoint.size]
    return setpoint, np.round(follows + 0.02 * rng.standard_normal(setpoint.size), 3)


def test_replay_finds_a_derivative_filter_other_than_the_one_stated():
    setpoint, measured = signals()
    ran = replace(OWN, derivative_filter_s=5.0)
    effort = unlimited_effort(ran, GAINS, setpoint, measured, first_effort=3.0)

    found = replay([Stretch("log", 0.0, setpoint, measured, effort)], OWN, None)

    assert found.explained
    assert found.ran.as_tuple() == pytest.approx(GAINS.as_tuple(), rel=1e-3)
    assert found.controller.derivative_filter_s == pytest.approx(5.0, rel=1e-3)


@pytest.mark.parametrize(("stated", "agrees"), [(GAINS, True), (replace(GAINS, I=0.1), False)])
def test_a_log_of_every_third_sample_is_thin_and_tells_the_gains(stated, agrees):
    setpoint, measured = signals()
    effort = unlimited_effort(OWN, GAINS, setpoint, measured, first_effort=3.0)
    every_third = Stretch("log", 0.0, *(one[::3] for one in (setpoint, measured, effort)))

    found = replay([every_third], replace(OWN, sampling_Hz=1.0 / 3.0), stated)

    assert found.is_thin
    assert found.agrees == agrees
    assert "thinner than the loop" in found.sentence()


def test_gains_that_changed_within_a_log_are_two_sets_each_from_its_time():
    setpoint, measured = signals()
    second = Gains(6.0, 0.1, 0.0, 0.0)
    efforts = [
        unlimited_effort(OWN, gains, setpoint[rows], measured[rows], first_effort=3.0)
        for gains, rows in ((GAINS, slice(1000)), (second, slice(1000, None)))
    ]
    columns = {
        "time": np.arange(setpoint.size) * 1.0,
        "setpoint": setpoint,
        "measurement": measured,
        "effort": np.concatenate(efforts),
    }

    sets = gain_sets(LoopLog("log", 1.0, (columns,), None, {}, {}, ()), OWN, None)

    assert [one.replay.ran.P for one in sets] == pytest.approx([GAINS.P, second.P], rel=1e-3)
    assert sets[0].stop_s == pytest.approx(1000.0, abs=5.0)
