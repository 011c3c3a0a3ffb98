"""A schedule tuned as one thing: its space, its tuner, the run over reels of several lengths."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.studies.joint.procedure import tune_schedule
from estune.studies.joint.reels import AlternatingReels
from estune.studies.joint.schedule_space import ScheduleSpace
from estune.studies.joint.schedule_tuner import ScheduleTuner
from estune.tuners.observation import Observation
from tests.support_runs import ArithmeticRig

START = Gains(0.5, 10.0, 0.005, 0.02)
ENDS = (0.5, 1.4)


def tuner_over(lengths, inside="least_squares_gradient", search_trials=10_000):
    return ScheduleTuner(START, lengths, ("I",), inside, search_trials)


def cost_at(gains: Gains, length: float, level: float = 1.0) -> float:
    """Least at P 1, and at an I that falls with length."""
    away = math.log(gains.P) ** 2 + math.log(gains.I / (50.0 - 20.0 * length)) ** 2
    return level * (1.0 + away)


def searched(lengths, trials, levels=None, inside="least_squares_gradient"):
    tuner = tuner_over(lengths, inside)
    state, asked = tuner.start(), []
    for k in range(trials):
        length = lengths[k % len(lengths)]
        gains = tuner.space.gains(tuner.ask(state))
        asked.append(gains)
        level = (levels or {}).get(length, 1.0)
        state = tuner.tell(state, Observation(cost_at(gains, length, level)))
    return tuner, state, asked


def test_a_point_and_the_schedule_made_of_it_give_the_same_gains():
    space = ScheduleSpace.over(START, ENDS, ("P", "I"))
    point = tuple(v * f for v, f in zip(space.start, (1.0, 3.0, 7.0, 2.0, 0.5, 1.1), strict=True))
    schedule = space.schedule(point, 15.0)
    for length in (0.3, 0.5, 0.8, 1.4, 2.0):
        ours, theirs = space.gains_at(point, length), schedule.gains(length, 15.0)
        assert np.allclose(ours.as_tuple(), theirs.as_tuple(), rtol=1e-12)
    half_way = space.gains_at(point, 0.95).P  # from 1 to 3 times
    assert half_way == pytest.approx(2.0 * START.P)


@pytest.mark.parametrize(
    ("inside", "trials", "within"), [("newton", 300, 0.02), ("otis", 1500, 0.1)]
)
def test_a_tuner_inside_finds_a_straight_line_through_lengths(inside, trials, within):
    tuner, state, _ = searched(ENDS, trials, inside=inside)
    found = tuner.schedules.schedule(tuner.recommended(state), 15.0)
    middle = found.gains(1.0, 15.0).I
    assert middle == pytest.approx(30.0, rel=within)
    assert found.I.slope == pytest.approx(-20.0, rel=within)
    assert found.P.at(1.0, 15.0) == pytest.approx(1.0, rel=within)


def test_the_level_of_a_length_however_high_changes_no_proposal():
    _, _, plain = searched(ENDS, 60)
    _, _, raised = searched(ENDS, 60, {0.5: 100.0, 1.4: 0.01})
    pairs = zip(plain, raised, strict=True)
    assert all(np.allclose(a.as_tuple(), b.as_tuple(), rtol=1e-6) for a, b in pairs)


def test_gains_that_were_unsafe_at_one_length_are_not_tried_at_the_next():
    lengths = (0.5, 0.95, 1.4)
    tuner = tuner_over(lengths)
    state = tuner.start()
    for k in range(30):
        before = tuner._proposal(state)
        unsafe = k % 7 == 3
        state = tuner.tell(state, Observation(1.5, censored=unsafe))
        assert (tuner._proposal(state) == before) <= (not unsafe)


def test_trials_go_round_the_reels_and_a_limit_of_one_is_a_limit_of_all():
    rigs = [ArithmeticRig(name=name) for name in ("short", "long")]
    tight = replace(rigs[1].description.limits, tension_max_N=30.0)
    rigs[1].description = replace(rigs[1].description, limits=tight)
    reels = AlternatingReels(rigs)
    assert reels.describe().limits.tension_max_N == 30.0
    with pytest.raises(RigError, match="are for one length"):
        reels.apply(START)
    found = tune_schedule(dict(zip(ENDS, rigs, strict=True)), trials=8, repeats=2, journal=False)
    assert [len(rig.asked) for rig in rigs] == [8, 8]  # 2 + 4 + 2 of each
    assert set(found.before) == set(found.after) == set(ENDS)


def test_a_schedule_tuned_at_the_ends_costs_little_more_than_the_optimum_between():
    reels = {length: plants.reference_reel(length) for length in ENDS}
    found = tune_schedule(reels, tuner="newton", trials=80, journal=False)
    assert found.success
    cost, between = found.result.plan.cost, plants.reference_reel(0.9)

    def of(gains):
        table = np.tile(gains, (60, 1))
        return plants.batch_costs(between, table, None, cost, seed=9, workers=1).mean()

    best = minimize(
        lambda logs: min(of(np.exp(logs)), 1e3),
        np.log((1.2, 35.0, 0.016, 0.002)),
        method="Nelder-Mead",
        options={"maxiter": 120},
    )
    assert of(found.schedule.gains(0.9, 15.0).as_tuple()) < 1.03 * best.fun


def test_a_run_that_was_cut_off_goes_on_and_runs_no_trial_twice(tmp_path):
    class CutOff(ArithmeticRig):
        left = 9

        def run(self, request):
            if self.left == 0:
                raise KeyboardInterrupt
            self.left -= 1
            return super().run(request)

    settings = {"trials": 20, "repeats": 2, "tuner": "least_squares_gradient"}
    uncut = {length: ArithmeticRig() for length in ENDS}
    whole = tune_schedule(uncut, folder=tmp_path / "whole", **settings)
    cut = {length: CutOff() for length in ENDS}
    with pytest.raises(KeyboardInterrupt):
        tune_schedule(cut, folder=tmp_path / "cut", **settings)
    for rig in cut.values():
        rig.left = 100
    found = tune_schedule(cut, folder=tmp_path / "cut", **settings)
    assert found.schedule == whole.schedule
    ids = [request.trial_id for rig in cut.values() for request in rig.asked]
    assert len(ids) == len(set(ids))
    with pytest.raises(InvalidInput, match="other settings"):
        tune_schedule(cut, folder=tmp_path / "cut", **{**settings, "trials": 30})


@pytest.mark.parametrize(
    ("lengths", "changed", "said"),
    [
        ((0.5,), {}, "two lengths at least"),
        (ENDS, {"straight": ("K",)}, "there is no gain 'K'"),
        (ENDS, {"tuner": "best"}, "there is no tuner 'best'"),
        (ENDS, {"trials": 1}, "one trial for each length"),
    ],
)
def test_what_cannot_be_a_schedule_is_refused(lengths, changed, said):
    rigs = {length: ArithmeticRig() for length in lengths}
    with pytest.raises(InvalidInput, match=said):
        tune_schedule(rigs, journal=False, **changed)


def test_a_reel_that_says_another_length_is_refused():
    reels = {0.5: plants.reference_reel(0.5), 1.4: plants.reference_reel(1.0)}
    with pytest.raises(InvalidInput, match=r"1 m long, not 1\.4 m"):
        tune_schedule(reels, journal=False)


def test_every_name_of_a_schedule_is_told_once_or_at_both_ends():
    names = ("P", "I_short", "I_long", "D", "setpoint_filter_s")
    whole = dict.fromkeys(names, 1.0)
    for left_out in itertools.chain(names):
        rest = tuple(name for name in whole if name != left_out)
        ones = (1.0,) * len(rest)
        with pytest.raises(InvalidInput, match="give it once or at each end"):
            ScheduleSpace(rest, ones, (0.1,) * len(rest), (10.0,) * len(rest), length_m=ENDS)
