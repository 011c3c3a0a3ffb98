"""Tuning of several reels to one cost: the target-cost tuner, the procedure, its records."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import estune
import plants
from estune.cli import run
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.run.journal import Journal
from estune.studies.match.outcome import MatchOutcome, classify, estimate_cost
from estune.studies.match.reel_matcher import Settings
from estune.studies.match.target_cost_tuner import TargetCostTuner, detuning_path
from estune.tuners.observation import Observation
from tests.support_runs import ArithmeticRig

TUNED = Gains(1.2, 36.0, 0.02, 0.002)
BRIEF = Settings(tuner="least_squares_gradient", trials=60, match_trials=12, repeats=5)


def cost_along(u: float) -> float:
    """Cost that rises from 1 like that of a reel: flat at first, then steeper."""
    return math.exp(0.08 * u + 0.35 * u * u)


def run_search(target: float, noise: float, seed: int, trials: int = 16, unsafe_from: float = 9.0):
    """Final distance, and whether any trial lay beyond a known unsafe one."""
    seeker, random = TargetCostTuner(detuning_path(TUNED), target), np.random.default_rng(seed)
    state, least_unsafe, trespassed = seeker.start(), math.inf, False
    for _ in range(trials):
        (K,) = seeker.ask(state)
        u = math.log(TUNED.P / K)
        trespassed |= u >= least_unsafe
        if u >= unsafe_from:
            least_unsafe = min(u, least_unsafe)
            state = seeker.tell(state, Observation(math.nan, censored=True))
        else:
            cost = cost_along(u) * math.exp(noise * random.standard_normal())
            state = seeker.tell(state, Observation(cost))
    return math.log(TUNED.P / seeker.recommend(state)[0]), trespassed


@pytest.mark.parametrize("target", [1.02, 1.2, 1.8])
def test_target_cost_tuner_is_more_accurate_than_one_trial(target):
    costs = [cost_along(run_search(target, 0.01, seed)[0]) for seed in range(40)]
    errors = np.log(costs) - math.log(target)
    assert abs(errors.mean()) < 0.002
    assert errors.std() < 0.006


def test_target_cost_tuner_keeps_initial_gains_for_lower_targets():
    assert run_search(0.8, 0.01, seed=1)[0] < 0.02


def test_target_cost_tuner_repeats_no_unsafe_trial():
    point, trespassed = run_search(2.0, 0.0, seed=1, unsafe_from=0.7)
    assert 0.5 < point < 0.7
    assert not trespassed


def test_detuning_path_changes_only_the_loop_gain():
    path = detuning_path(TUNED)
    half = path.gains((TUNED.P / 2.0,))
    assert np.allclose(half.as_tuple(), (0.6, 18.0, 0.01, 0.002), rtol=1e-12)
    assert path.high == (TUNED.P,)


def test_cost_interval_covers_its_mean_in_95_of_100_cases():
    random = np.random.default_rng(3)
    rows = 1.4 * np.exp(0.02 * random.standard_normal((2000, 6)))
    covered = [level.low <= 1.4 <= level.high for level in map(estimate_cost, rows.tolist())]
    assert 0.935 < np.mean(covered) < 0.965


@pytest.mark.parametrize(
    ("costs", "standing"),
    [
        ((1.399, 1.401, 1.400, 1.402), MatchOutcome.PASS),
        ((1.499, 1.501, 1.500, 1.502), MatchOutcome.OFF_TARGET),
        ((1.30, 1.50, 1.36, 1.44), MatchOutcome.NOT_SHOWN),
        ((1.399, 1.401, math.inf, 1.402), MatchOutcome.FAILED),
        ((1.4,), MatchOutcome.NOT_SHOWN),
    ],
)
def test_classify_passes_only_intervals_within_the_tolerance(costs, standing):
    assert classify(estimate_cost(costs), 1.4, 0.02)[0] is standing


def test_match_brings_different_reels_to_the_cost_of_the_worst():
    reels = {
        "stiff": plants.reference_reel(),
        "soft": plants.reference_reel(cable_EA_N=8e3),
        "heavy": plants.reference_reel(drum_inertia_kg_m2=2.3e-3),
    }
    result = estune.match(reels, settings=BRIEF, journal=False)
    assert result.passed
    # The true cost: the mean over noise that no trial of the matching used.
    before, after = (
        [
            plants.batch_costs(
                reels[r.label], np.tile(g.as_tuple(), (100, 1)), None, result.cost, seed=77
            ).mean()
            for r, g in ((r, getattr(r, which)) for r in result.reels)
        ]
        for which in ("tuned", "gains")
    )
    assert np.std(after) < 0.2 * np.std(before)
    assert np.mean(after) < 1.1 * max(before)
    assert result.cost.settling_time_s == max(
        reel.describe("", None).settling_time_s for reel in reels.values()
    )


def test_match_continues_without_reels_that_fail():
    class Away(ArithmeticRig):
        def describe(self):
            raise RigError("nobody there")

    targets = {
        "away": Away(),
        "unstable": plants.reference_reel(drum_inertia_kg_m2=8e-3),  # at its live gains
        "slow": plants.reference_reel(drum_inertia_kg_m2=5e-3),
        "good": plants.reference_reel(),
    }
    result = estune.match(targets, eta=1.1, settings=BRIEF, journal=False)
    outcomes = {reel.label: reel.outcome for reel in result.reels}
    assert outcomes == {
        "away": "failed",
        "unstable": "failed",
        "slow": "out of reach",
        "good": "pass",
    }
    assert "nobody there" in result.reels[0].reason
    assert "growing amplitude" in result.reels[1].reason
    assert not result.passed


def test_match_applies_gains_only_on_request_and_to_passing_reels():
    rigs = {"fast": ArithmeticRig(name="fast"), "slow": ArithmeticRig(name="slow")}
    rigs["slow"].best = replace(ArithmeticRig.best, I=60.0)
    start, settings = rigs["fast"].description.gains, replace(BRIEF, tolerance=0.05)
    unapplied = estune.match(rigs, eta=1.6, settings=settings, journal=False)
    assert unapplied.passed
    assert {rig.description.gains for rig in rigs.values()} == {start}
    live = estune.match(rigs, eta=1.6, settings=settings, journal=False, apply=True)
    assert [rig.description.gains for rig in rigs.values()] == [r.gains for r in live.reels]
    estune.match(rigs, eta=0.01, settings=settings, journal=False, apply=True)
    assert [rig.description.gains for rig in rigs.values()] == [r.gains for r in live.reels]


@pytest.mark.slow
def test_interrupted_matching_continues_and_repeats_no_trial(tmp_path):
    class CutOff(ArithmeticRig):
        trials_left = 50

        def run(self, request):
            if self.trials_left == 0:
                raise KeyboardInterrupt
            self.trials_left -= 1
            return super().run(request)

    uncut = {"a": ArithmeticRig(name="a"), "b": ArithmeticRig(name="b")}
    whole = estune.match(uncut, settings=BRIEF, folder=tmp_path / "whole" / "m")
    cut = {"a": CutOff(name="a"), "b": CutOff(name="b")}
    for _ in range(9):
        try:
            result = estune.match(cut, settings=BRIEF, folder=tmp_path / "cut" / "m")
            break
        except KeyboardInterrupt:
            for rig in cut.values():
                rig.trials_left = 60
    ids = [request.trial_id for rig in cut.values() for request in rig.requests]
    assert len(ids) == len(set(ids))
    assert [r.gains for r in result.reels] == [r.gains for r in whole.reels]
    with pytest.raises(InvalidInput, match="was begun with trials 60, not 50"):
        estune.match(cut, settings=replace(BRIEF, trials=50), folder=tmp_path / "cut" / "m")


@pytest.mark.slow
def test_match_command_matches_two_rigs_over_zenoh(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    reels = plants.reference_reel(), plants.reference_reel(cable_EA_N=8e3)
    with (
        zenoh.serve(reels[0].rig(name="left", seed=1), "tcp/127.0.0.1:0") as left,
        zenoh.serve(reels[1].rig(name="right", seed=2), "tcp/127.0.0.1:0") as right,
    ):
        targets = [f"left={left.endpoint}", f"right={right.endpoint}"]
        counts = ["--trials", "60", "--match-trials", "12", "--repeats", "5"]
        code = run(["match", *targets, *counts, "--folder", "m", "--json", "--apply"])
        live = {}
        for server in (left, right):
            with zenoh.connect(server.endpoint) as rig:
                live[rig.describe().name] = rig.describe().gains
    printed = json.loads(capsys.readouterr().out)
    assert code == 0
    assert printed["passed"]
    rows = list(csv.DictReader((tmp_path / "m" / "match.csv").read_text().splitlines()))
    for row in rows:
        gains = [float(row[f"matched_{n}"]) for n in ("P", "I", "D", "setpoint_filter_s")]
        assert tuple(gains) == live[row["rig"]].as_tuple()
        assert row["passed"] == row["live"] == "True"
    page = (tmp_path / "m" / "match.html").read_text()
    assert "2 of 2 reels pass" in page
    assert "http" not in page.split("</style>")[1].split("<figure")[0]
    assert all(Journal.open(p).fact("status") == "finished" for p in (tmp_path / "m").glob("m-*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one.toml"], "worst of several"),
        (["one.toml", "two.toml", "--eta", "low"], "neither a number nor auto"),
        (["one.toml", "two.toml", "--eta", "-1"], "above zero"),
        (["a=one.toml", "a=two.toml"], "given twice"),
        (["tcp/127.0.0.1:1", "tcp/127.0.0.1:1"], "given twice"),
        (["one.toml", "two.toml", "--tolerance", "2"], "between 0 and 1"),
        (["one.toml", "two.toml", "--repeats", "1"], "at least 3"),
        (["one.toml", "two.toml", "--apply"], "a model keeps no gains"),
        (["one.toml", "two.toml", "--duration-s", "-1"], "duration_s"),
    ],
)
def test_match_command_refuses_invalid_arguments_in_one_line(
    arguments, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name in ("one.toml", "two.toml"):
        (tmp_path / name).write_text("[reel]\ncable_length_m = 0.8\n")
    assert run(["match", *arguments]) == 2
    assert message in capsys.readouterr().err
