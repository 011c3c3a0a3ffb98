"""Springs and sensors whose slope changes, and gains that change, in the identified loop."""

from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.loop_model.fitting import fit_loop
from estune.loop_model.intervals import predict_with_intervals
from estune.loop_model.margins import robustness
from estune.loop_model.prediction import predict
from estune.run.planning import step_trial
from estune.trial import TrialRequest
from estune.trial.loop_records import loop_signals
from experiments.loop_claims.mild_loops import SAMPLING_HZ, Mild, MildRig
from tests.test_loop_model import COST

STRAIGHT = Mild("bent", frequency_Hz=5.0, damping=0.3, dead=2, noise=0.001)
TRIED = Gains(0.5, 10.0, 0.02, 0.02)


def fitted(loop):
    """The fit of two timid trials and three others, the trial and the loop's rig."""
    rig = MildRig(loop, 3)
    description, cost = rig.describe(), replace(COST, settling_time_s=0.2)
    timid = loop.start
    gains = (timid, timid, TRIED, replace(TRIED, P=0.8), TRIED)
    records = [
        loop_signals(
            rig.run(TrialRequest("run", number, at, description.step)),
            description.step,
            description,
        ).record
        for number, at in enumerate(gains)
    ]
    fit = fit_loop(records, SAMPLING_HZ, cost.settling_time_s)
    return fit, step_trial(description, description.step, cost)


@pytest.mark.parametrize(
    "change", [{"stiffening": 1.6}, {"stiffening": 0.7}, {"sensor": 1.3}, {"sensor": 0.8}]
)
def test_loop_whose_slope_changes_is_known_at_the_end_of_the_step(change):
    loop = replace(STRAIGHT, **change)
    fit, trial = fitted(loop)
    assert not fit.model.bend.is_straight
    told = predict(fit.model, trial, TRIED)
    assert told.sensitivity == pytest.approx(loop.sensitivity(TRIED, 0), rel=0.015)
    assert told.overshoot == pytest.approx(loop.overshoot(TRIED, 0), abs=0.005)


def test_loop_whose_gain_drifts_shows_no_bend():
    fit, _ = fitted(replace(STRAIGHT, drift=1.0))
    assert fit.model.bend.is_straight
    assert fit.strengths


def test_margins_are_those_of_the_straight_plant():
    fit, trial = fitted(STRAIGHT)
    assert fit.model.bend.is_straight
    true = STRAIGHT.sensitivity(TRIED, 0)
    found = robustness(fit.model, TRIED, trial.controller).sensitivity
    assert found == pytest.approx(true, rel=0.015)
    assert np.isfinite(predict(fit.model, trial, TRIED).cost)


def test_loop_whose_gain_changes_between_trials_is_known_at_the_present_one():
    for change in ({"drift": 1.0}, {"varying": 0.05}):
        loop = replace(STRAIGHT, **change)
        fit, trial = fitted(loop)
        assert fit.is_white
        assert len(fit.strengths) == 5
        told = predict_with_intervals(fit, trial, TRIED)
        for true, at in (
            (loop.sensitivity(TRIED, 4), told.sensitivity),
            (loop.overshoot(TRIED, 4), told.overshoot),
        ):
            assert at.low <= true <= at.high
