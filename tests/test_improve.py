"""From a rig with something hidden in it to a better model, and to gains tuned with it."""

import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import control
import numpy as np
import pandas as pd
import pytest

import plants
from estune.cli import run
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.run.trial_file import TrialFile, run_trial
from estune.trial import Outcome, RigLimits
from estune.trial.profiles import StepProfile
from plants.diagnosis.data.records import read_measurements
from plants.diagnosis.experiments.designs import Experiment, initial_experiments
from plants.effects import CoulombFriction
from plants.improvement import improve as module
from plants.improvement.experiment_runner import ExperimentRunner
from plants.improvement.improve import at_rig
from plants.improvement.result import Costs
from plants.improvement.tuning import is_worse, tune_with_model, way
from tests.serve_rig import served
from tests.support_improve import FEW, GAINS, REEL, SHORT, about, records, watched

PLANT_20_N_A = plants.linear_plant(
    control.tf([1440.0], [1.0, 40.0, 1600.0]),
    0.004,
    400.0,
    noise_rms_N=0.02,
    newtons_per_ampere=20.0,
    output_min_N=-120.0,
    output_max_N=120.0,
    limits=RigLimits(0.0, 40.0, 60.0),
    profile=StepProfile(15.0, 10.0, 0.2, 1.5),
    settling_time_s=0.2,
)
"""A plant that takes 20 N for an ampere; its rig is known by its linear model."""


@pytest.mark.slow
def test_improved_model_has_the_hidden_effect_and_predicts_costs(tmp_path):
    rig = (REEL + CoulombFriction(torque_Nm=0.05)).rig(seed=7)
    live = rig.describe().gains
    found = plants.improve(rig, REEL, folder=tmp_path / "x", effects=FEW, tuning=SHORT)
    assert found.added == ("coulomb_friction",)
    assert found.rounds[0].diagnosis.verdict == "named"
    assert found.diagnosis.verdict == "none"  # with records that had no part in finding it
    assert set(found.rounds[1].experiments).isdisjoint(found.rounds[0].experiments)
    assert rig.describe().gains == live
    own, tuned = found.costs[0], found.costs[-1]
    assert own.gains == live
    assert tuned.measured < own.measured
    for costs in (own, tuned):
        assert costs.error_improved < 0.05
    assert max(c.error_given for c in found.costs) > 3.0 * max(
        c.error_improved for c in found.costs
    )
    kept = read_measurements(tmp_path / "x" / "data")
    assert len(kept.measurements) == sum(len(one.experiments) for one in found.rounds)
    told = json.loads((tmp_path / "x" / "improvement.json").read_text())
    assert told["effects"] == ["coulomb_friction"]
    assert [c["label"] for c in told["costs"]] == [c.label for c in found.costs]


@pytest.mark.slow
def test_records_that_are_there_already_are_explained_with_the_experiments(
    tmp_path, monkeypatch, capsys
):
    m, seen = records(REEL)[0], []
    columns = {"t": m.time_s, "F": 1e3 * m.tension_N, "i": m.current_A, "q": m.angle_rad}
    pd.DataFrame(columns).to_csv(tmp_path / "mine.csv", index=False)

    def explain(_model, records, **_):
        seen.extend(records)
        raise InvalidInput("enough")

    monkeypatch.setattr(module, "explain", explain)
    where, mapped = tmp_path / "improvement", "time=t,tension=F,current=i,angle=q"
    options = ["--data", str(tmp_path / "mine.csv"), "--map", mapped, "--unit", "tension=mN"]
    command = ["improve-model", "plants:reference_reel", "--folder", str(where), *options]
    assert run([*command, "--quiet"]) == 2
    assert "enough" in capsys.readouterr().err
    np.testing.assert_allclose(seen[0].tension_N, m.tension_N, rtol=1e-12)
    assert len(seen) == 1 + len(initial_experiments(about("reel")))


@pytest.mark.slow
def test_complete_model_is_unchanged_over_the_link(tmp_path, capsys):
    with served("simulated") as rig:
        wanted = ["improve-model", rig.endpoint, "--folder", str(tmp_path / "x"), "--json"]
        wanted += ["--model-trials", "20", "--trials", "4"]
        assert run(wanted) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["effects"], len(told["rounds"])) == ("none", [], 1)
    for costs in told["costs"]:
        assert costs["improved"] == pytest.approx(costs["measured"], rel=0.03)


def costs(given, improved):
    return Costs("the rig's own", GAINS, given, improved, 1.0, 0.01)


def test_improved_model_is_refused_only_if_it_predicts_the_rig_worse_beyond_doubt():
    assert is_worse(costs(1.05, 0.9))
    assert is_worse(costs(1.0, float("nan")))
    assert not is_worse(costs(1.05, 0.94))
    assert not is_worse(costs(float("nan"), 0.5))


def test_way_to_the_gains_of_a_model_has_no_large_step():
    start, goal = Gains(0.4, 12.0, 0.0, 0.03), Gains(8.1, 3.0, 0.02, 0.03)
    passed = [start, *way(start, goal)]
    assert passed[-1] == goal
    for one, other in itertools.pairwise(passed):
        for a, b in zip(one.as_tuple(), other.as_tuple(), strict=True):
            assert a == 0.0 or 1.0 / 1.5 <= b / a <= 1.5 + 1e-9 or b < 0.02
    assert list(way(start, start)) == []


def test_gains_tried_on_the_rig_stop_before_the_model_fails(tmp_path):
    """A model of half the stiffness is tuned to gains with which the real reel rings."""
    soft = plants.reference_reel(cable_EA_N=600.0, structure_stiffness_N_m=1200.0)
    rig = REEL.rig()
    seen = []
    ids = watched(rig, 0, None)
    real = rig.run
    rig.run = lambda request: seen.append(real(request)) or seen[-1]
    lab = ExperimentRunner(rig, rig.describe(), tmp_path, "now", lambda _: None)
    tuned = tune_with_model(lab, soft, soft, SHORT)
    approach = [r for r in seen if r.trial_id.startswith("approach")]
    assert ids
    assert all(r.outcome is Outcome.DONE for r in approach)
    first = tuned.result.start
    assert first.cost <= tuned.costs[0].measured + 0.1


@pytest.mark.slow
def test_rig_known_by_its_linear_model_keeps_its_effort_per_ampere(tmp_path):
    found = plants.improve(
        PLANT_20_N_A.rig(seed=3), folder=tmp_path / "x", effects=FEW, tuning=SHORT
    )
    assert found.diagnosis.verdict == "none"
    assert found.model.newtons_per_ampere == 20.0
    for one in found.costs:
        assert one.error_improved < 0.05
    plants.save_model(found.model, tmp_path / "m.toml")
    assert plants.load_model(tmp_path / "m.toml").newtons_per_ampere == 20.0


@pytest.mark.parametrize(
    ("plant", "line"),
    [
        (plants.stage(95.0, 200.0), "current_limit_A"),
        (
            plants.stage(95.0, 200.0, current_limit_A=50.0),
            "speed_max_m_s. and travel_max_rad",
        ),
        (plants.servo(0.1, 0.2, current_limit_A=5.0, speed_max_rad_s=9.0), "travel_max_rad"),
        (
            plants.linear_plant(control.tf([1.0], [1.0, 1.0]), gains=Gains(1.0, 1.0, 0.0, 0.0)),
            "output_max_N",
        ),
    ],
)
def test_nothing_is_run_on_a_machine_without_limits(plant, line, tmp_path):
    with pytest.raises(InvalidInput, match=rf"no limit of its .* add .*{line}"):
        plants.improve(plant, folder=tmp_path / "x")
    assert not (tmp_path / "x").exists()
    step = TrialFile("step", plant.profile)
    with pytest.raises(InvalidInput, match=f"nothing is run on it: add .*{line}"):
        run_trial(plant.rig(), step)


def test_experiment_that_would_move_a_drive_too_far_is_not_run(tmp_path):
    """1 N m on 0.1 kg m2 for 0.8 s: 8 rad/s and 3.2 rad, and a quarter beside."""
    step = StepProfile(0.0, 1.0, 0.2, 1.0, loop="open")
    allowed = {"current_limit_A": 5.0, "speed_max_rad_s": 11.0, "travel_max_rad": 4.2}
    for name, unlike in (("travel", {"travel_max_rad": 3.8}), ("speed", {"speed_max_rad_s": 9.0})):
        rig = plants.servo(0.1, 0.0, **allowed | unlike).rig()
        with pytest.raises(InvalidInput, match=f"reach a {name} of .* raise {name}_max_rad"):
            run_trial(rig, TrialFile("step", step))
        lab = ExperimentRunner(rig, rig.describe(), tmp_path / name, "now", lambda _: None)
        assert lab.run([Experiment("step", "a step", step)]) == ()
        assert "step was not run: the trial would reach" in lab.remarks[0]
    done = run_trial(plants.servo(0.1, 0.0, **allowed).rig(), TrialFile("step", step))
    assert np.ptp(done.angle_rad) == pytest.approx(3.2, rel=0.02)


def test_travel_of_a_drive_that_comes_back_counts_from_where_it_starts():
    angle = np.concatenate([np.linspace(0.0, 0.9, 500), np.linspace(0.9, 0.45, 500)])
    model = SimpleNamespace(response=lambda *_: angle)
    about = plants.servo(0.1, 0.0, current_limit_A=5.0, travel_max_rad=1.0).rig().describe()
    step = StepProfile(0.0, 1.0, 0.2, 1.0, loop="open")
    with pytest.raises(InvalidInput, match=r"a travel of 0\.9 by the model"):
        replace(about, linear_model=model).check_motion(step)


@pytest.mark.parametrize("plant", [PLANT_20_N_A, REEL, plants.unloaded_reel()])
def test_model_at_a_rig_has_its_effort_per_ampere(plant):
    about = replace(plant.describe("rig", None), newtons_per_ampere=31.0)
    at = at_rig(plant, about)
    assert at.newtons_per_ampere == pytest.approx(31.0)
    assert at.controller.output_max_N == pytest.approx(plant.controller.output_max_N)
