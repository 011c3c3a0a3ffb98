"""Rigs that cannot be tuned are refused after the first trial, with the remedy."""

from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError, UnsafeStart
from estune.interop import margins
from estune.run.first_trial import check_answer
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from tests.support_targets import slowly_unstable

STEP = StepProfile(0.0, 1.0, 0.2, 2.0)


class Changed:
    """A rig whose records a function changes."""

    def __init__(self, rig, change):
        self._rig, self._change = rig, change
        self.ran = 0

    def __getattr__(self, name):
        return getattr(self._rig, name)

    def run(self, request):
        self.ran += 1
        return self._change(self._rig.run(request))


def plant(gain=1.0, **settings):
    chosen = {"noise_rms_N": 0.003, "gains": Gains(0.1, 0.2, 0.001, 0.05), **settings}
    transfer = control.tf([gain], [0.2, 1.0])
    return plants.linear_plant(
        transfer, sampling_Hz=100.0, profile=STEP, settling_time_s=1.0, **chosen
    )


def tune(rig, **settings):
    return estune.tune(rig, **{"journal": False, "watch": None, **settings})


@pytest.mark.parametrize("noise", [0.0, 0.04])
def test_dead_measurement_is_refused_after_one_trial(noise):
    def dead(record):
        rng = np.random.default_rng(1)
        return replace(record, tension_N=15.0 + noise * rng.standard_normal(record.time_s.size))

    rig = Changed(plants.reference_reel().rig(), dead)
    with pytest.raises(InvalidInput, match="does not answer"):
        tune(rig)
    assert rig.ran == 1


def test_wrong_sign_is_refused_after_one_trial():
    rig = Changed(plant(-1.0).rig(), lambda record: record)
    with pytest.raises(InvalidInput, match="wrong sign"):
        tune(rig)
    assert rig.ran == 1


@pytest.mark.parametrize(
    ("plant_gain", "gains", "match"),
    [
        (-1.0, Gains(2.0, 8.0, 0.001, 0.05), "wrong sign .*; start from gentler gains"),
        (100.0, Gains(2.0, 8.0, 0.001, 0.05), "left the finite range[^:]*; start from gentler"),
    ],
)
def test_diverging_first_trial_tells_a_wrong_sign_from_large_gains(plant_gain, gains, match):
    with pytest.raises(UnsafeStart, match=match) as refused:
        tune(plant(plant_gain, gains=gains, dead_time_s=0.1))
    assert "eta_max" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda r: {"setpoint_N": np.append(np.zeros(5), r.setpoint_N[:-5])},
            "setpoint at sample 21 is 0 where",
        ),
        (lambda r: {"setpoint_N": 1.05 * r.setpoint_N}, "setpoint at sample 20 is 1.05 where"),
        (lambda _: {"sampling_Hz": 99.0}, "sampled at 99 Hz"),
        (lambda r: {"current_A": r.current_A + 9.0}, "beyond the limits of -2 to 2"),
    ],
)
def test_record_of_another_trial_is_refused_with_its_first_difference(change, match):
    limited = plant(output_min_N=-2.0, output_max_N=2.0)
    rig = Changed(limited.rig(), lambda record: replace(record, **change(record)))
    with pytest.raises(RigError, match=match):
        tune(rig)
    assert rig.ran == 1


def test_load_of_a_slow_integrating_plant_is_not_taken_for_a_wrong_sign():
    slow = plants.linear_plant(
        *(control.tf([0.2], [1.0, 0.0]), 0.3, 20.0),
        noise_rms_N=0.003,
        gains=Gains(0.8, 0.02, 0.1, 0.1),
        profile=StepProfile(0.0, 1.0, 1.0, 40.0),
        settling_time_s=15.0,
    )
    rig = slow.rig(seed=1)
    made = estune.tune(rig, cost="rejection", trials=1, journal=False, watch=None).plan
    first = rig.run(TrialRequest("again", 0, made.start, made.step))
    check_answer(first, made, rig.describe())


def test_effort_that_stays_at_its_limit_is_refused():
    weak = plant(output_min_N=-0.5, output_max_N=0.5, gains=Gains(2.0, 20.0, 0.001, 0.05))
    with pytest.raises(InvalidInput, match="at its limit"):
        tune(weak)


@pytest.mark.slow
def test_search_by_cost_alone_stays_where_the_identified_loop_is_stable():
    result = tune(slowly_unstable().rig(seed=1), trials=12)
    about = result.rig
    stable = [
        margins(about.linear_model, e.gains, about.controller).stable for e in result.entries
    ]
    assert all(stable)
