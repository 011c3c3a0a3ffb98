"""Tracking and rest beside the cost: in results, on disk, in reports and comparisons."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import estune
import plants
from estune.cli import run
from estune.run.behaviour import LoopBehaviour, measure_all, measure_behaviour
from estune.trial import Outcome, RigLimits
from estune.trial.profiles import StepProfile
from estune.trial.tracking import rest_of, resting_profile, tracking_of, tracking_profile
from plants.effects import CoulombFriction
from plants.remedies.behaviour import MEASURES, behaviour
from tests.support_rigs import ScriptedRig

PLAIN = plants.reference_reel()
STICKY = PLAIN + CoulombFriction(0.05)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    how = {"trials": 6, "repeats": 2, "folder": folder, "run": "one", "watch": None}
    return estune.tune(PLAIN, tracking=True, **how)


def test_result_has_tracking_and_rest_at_both_gains_and_keeps_them_on_disk(tuned):
    found = tuned.behaviour
    assert set(found) == {"start", "tuned"}
    assert found["tuned"].tracking < 0.7 * found["start"].tracking
    assert estune.load(tuned.folder).behaviour == found
    labels = [row.label for row in tuned.rows()]
    assert labels[-3:] == ["tracking error (rms)", "error at reversals", "deviation at rest"]
    row = next(row for row in tuned.rows() if row.label == "tracking error (rms)")
    assert row.tuned == tuned.rig.measured(found["tuned"].tracking, 3)
    assert "error at reversals" in tuned._repr_html_()


def test_the_trials_are_none_of_the_run(tuned):
    without = estune.tune(PLAIN, trials=6, repeats=2, journal=False, watch=None)
    assert without.behaviour == {}
    assert (without.nfev, without.gains) == (tuned.nfev, tuned.gains)


def test_a_rig_measures_what_a_model_predicts():
    rig = STICKY.rig()
    about = rig.describe()
    measured = measure_behaviour(rig, about, about.gains, "b")
    predicted = dict(
        zip(MEASURES, behaviour(STICKY, about.gains, about.settling_time_s), strict=True)
    )
    assert measured.tracking == pytest.approx(predicted["tracking"], rel=0.02)
    assert measured.reversal == pytest.approx(predicted["reversal"], rel=0.05)
    assert measured.rest == pytest.approx(predicted["rest"], rel=0.1)


def test_tracking_is_judged_after_the_first_cycle_which_begins_from_rest():
    profile, rate = tracking_profile(PLAIN.profile, 0.1), 1000.0
    error = np.full(profile.samples(rate), 0.2)
    second = round((profile.start_s + profile.period_s) * rate)
    error[:second] = 5.0
    assert tracking_of(profile, 0.1, rate, error) == pytest.approx((0.2, 0.2))
    for turn in (1.25, 1.75, 2.25, 2.75):
        at = round((profile.start_s + turn * profile.period_s) * rate)
        error[at + 50] = -0.2 * turn
    rms, reversal = tracking_of(profile, 0.1, rate, error)
    assert rms == pytest.approx(0.2, rel=0.01)
    assert reversal == pytest.approx(0.2 * 2.0)
    for after_s, counts in ((0.118, True), (0.122, False)):
        late = np.full(profile.samples(rate), 0.2)
        late[round((profile.start_s + 1.25 * profile.period_s + after_s) * rate)] = 1.0
        reversal = tracking_of(profile, 0.1, rate, late).reversal
        assert reversal == pytest.approx(0.4 if counts else 0.2)


def test_nothing_is_said_of_the_tracking_of_a_triangle_that_was_cut_short_or_diverged():
    profile, rate = tracking_profile(PLAIN.profile, 0.1), 1000.0
    error = np.full(profile.samples(rate), 0.2)
    diverged = np.where(np.arange(error.size) == 7, np.inf, error)
    assert np.isfinite(tracking_of(profile, 0.1, rate, error)).all()
    for bad in (error[:-1], diverged):
        assert np.isnan(tracking_of(profile, 0.1, rate, bad)).all()


def test_triangle_lasts_as_the_loop_settles_and_is_as_wide_as_the_step_or_the_range_asks_for():
    step = StepProfile(10.0, 4.0, 0.5, 2.0)
    plain, wide = (tracking_profile(step, 0.2, one) for one in (None, RigLimits(5.0, 45.0, 60.0)))
    about = {"period_s": 3.0, "duration_s": 0.4 + 3 * 3.0, "start_s": 0.4}
    for found, middle, amplitude in ((plain, 12.0, 1.2), (wide, 25.0, 16.0)):
        expected = about | {"preload_N": middle, "amplitude_N": amplitude}
        assert {name: getattr(found, name) for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(("settling_s", "after_s"), [(0.2, 3.2), (0.05, 1.5)])
def test_rest_lasts_sixteen_settling_times_after_the_step_or_as_long_as_the_step_has(
    settling_s, after_s
):
    step = StepProfile(10.0, 4.0, 0.5, 2.0)
    assert resting_profile(step, settling_s) == replace(step, duration_s=0.5 + after_s)


@pytest.mark.parametrize(("restless", "rest"), [(0, 0.1), (1, 0.1), (3, 2.0), (4, 2.0)])
def test_rest_passes_over_a_single_slip_and_counts_hunting(restless, rest):
    rate, settling = 1000.0, 0.1
    part = round(8.0 * settling * rate) // 4
    sway = np.where(np.arange(part) % 2, 1.0, -1.0)
    tension = [sway * (2.0 if k < restless else 0.1) + 10.0 for k in range(4)]
    settling_part = np.linspace(0.0, 10.0, 4 * part)
    assert rest_of(settling, rate, np.concatenate([settling_part, *tension])) == pytest.approx(
        rest
    )


def test_nothing_moves_after_a_trial_that_was_interrupted_on_a_moving_rig():
    class Interrupted(ScriptedRig):
        def run(self, request):
            return replace(super().run(request), outcome=Outcome.INTERRUPTED, reason="power")

    rig = Interrupted(simulated=False, limits=RigLimits(0.0, 50.0, 60.0))
    gains = dict.fromkeys(("start", "tuned"), rig.describe().gains)
    found = measure_all(rig, rig.describe(), "run", gains, None)
    assert found["start"].endswith("was interrupted (power); check the rig")
    assert len(rig.requests) == 1


def test_what_a_rig_cannot_measure_is_told_and_the_result_stays(monkeypatch):
    rig = PLAIN.rig()
    perform = rig._perform

    def stopped(request):
        record = perform(request)
        if request.profile.kind != "triangle":
            return record
        object.__setattr__(record, "outcome", Outcome.GUARD)
        return record

    monkeypatch.setattr(rig, "_perform", stopped)
    result = estune.tune(rig, trials=4, repeats=2, tracking=True, journal=False, watch=None)
    assert "ended early" in result.behaviour["start"]
    assert any("not measured" in remark for remark in result.remarks())
    assert math.isfinite(result.fun)


@pytest.mark.slow
def test_comparison_shows_them_for_each_tuner(tmp_path, capsys):
    command = ["compare", "plants:reference_reel", "--tuners", "model_based,otis", "--trials", "3"]
    command += ["--repeats", "2", "--quiet", "--folder", str(tmp_path), "--json"]
    assert run(command) == 0
    told = json.loads(capsys.readouterr().out)
    text = json.dumps(told)
    for name in LoopBehaviour._fields:
        assert name in text
    assert "reversals" in (tmp_path / "comparison.html").read_text()
