"""From a rig with something hidden in it to a better model, and to gains tuned with it."""

import itertools
import json
import re
import shlex
from dataclasses import replace

import control
import numpy as np
import pandas as pd
import pytest

import plants
from estune.cli import run
from estune.core.gains import Gains
from estune.errors import Interrupted, InvalidInput, RigError
from estune.run.loop import Stopped
from estune.run.trial_file import TrialFile, read_trial
from estune.support.html_page import prose, render
from estune.trial import GUARD, LATE, Outcome, RigLimits, TrialRequest
from estune.trial.profiles import StepProfile, TriangleProfile
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.records import read_measurements
from plants.diagnosis.experiments.designs import candidate_experiments, initial_experiments
from plants.diagnosis.experiments.next_experiment import Evidence, next_experiment, rig_of
from plants.diagnosis.improvement import improve as module
from plants.diagnosis.improvement.experiment_runner import ExperimentRunner
from plants.diagnosis.improvement.improve import at_rig
from plants.diagnosis.improvement.page import page
from plants.diagnosis.improvement.result import Costs
from plants.diagnosis.improvement.tuning import ImprovementOptions, is_worse, tune_with_model, way
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.localisation import ResidualLocation, localise
from plants.effects import CoulombFriction, EyeletFriction
from tests.serve_rig import served

REEL = plants.reference_reel()
GAINS = REEL.describe("rig", None).gains
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
SHORT = ImprovementOptions(model_trials=40, rig_trials=6, watch=None)
FEW = ("coulomb_friction", "eyelet_friction", "dead_time")
RIGS = {
    "reel": REEL,
    "long, slack reel": plants.reference_reel(1.4, 8.0),
    "narrow limits": plants.reference_reel(tension_min_N=12.0, tension_max_N=18.0),
    "unloaded reel": plants.unloaded_reel(),
}


def about(name):
    return RIGS[name].describe("rig", None)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("make", [initial_experiments, candidate_experiments])
def test_experiments_and_predicted_tension_stay_within_limits(name, make):
    rig = about(name)
    experiments = make(rig)
    assert len({one.name for one in experiments}) == len(experiments) >= 5
    for one in experiments:
        rig.limits.check(one.profile)
        trial = plants.simulate(RIGS[name], rig.gains, one.profile)
        assert trial.diverged_at is None
        if rig.cable_length_m is not None:
            assert trial.tension_N.min() >= rig.limits.tension_min_N
            assert trial.tension_N.max() <= rig.limits.tension_max_N
    if make is initial_experiments:
        assert 25.0 < sum(one.profile.duration_s for one in experiments) < 31.0


def records(reel, seed=0):
    rig = reel.rig(seed=seed)
    known = rig.describe()
    return [
        MeasuredRecord.of(rig.run(TrialRequest("battery", n, known.gains, one.profile)))
        for n, one in enumerate(initial_experiments(known))
    ]


@pytest.fixture(scope="module")
def plain():
    seen = records(REEL)
    return Evidence(seen, noise_floor(seen), ResidualLocation((), ""), 1.0)


def test_deciding_experiment_separates_refitted_models(plain):
    rivals = {"coulomb": REEL + CoulombFriction(), "eyelet": REEL + EyeletFriction()}
    found = next_experiment("ambiguous", REEL, rivals, plain, about("reel"))
    assert found.separation == max(found.tried.values())
    assert found.trial.name == max(found.tried, key=found.tried.get)

    def apart(profile):
        """Independently: the readings' difference less gain, offset, delay and inertia."""
        one, other = (plants.simulate(m, about("reel").gains, profile) for m in rivals.values())
        parts = []
        for channel, sigma in (("tension_N", 0.04), ("angle_rad", 2e-4)):
            y, d = getattr(one, channel), getattr(other, channel) - getattr(one, channel)
            slopes = [np.ones_like(y), y, np.gradient(y), np.gradient(np.gradient(y))]
            A = np.stack(slopes, axis=1)
            left = d - A @ np.linalg.lstsq(A, d, rcond=None)[0]
            parts.append(np.mean((left / np.hypot(sigma, 0.004 * y.std())) ** 2))
        return sum(parts)

    profiles = {one.name: one.profile for one in candidate_experiments(about("reel"))}
    worst = min(found.tried, key=found.tried.get)
    assert apart(found.trial.profile) > 5.0 * apart(profiles[worst])


def test_no_experiment_for_indistinguishable_models(plain):
    same = {"one": REEL + CoulombFriction(), "other": REEL + CoulombFriction()}
    assert next_experiment("ambiguous", REEL, same, plain, about("reel")) is None
    assert next_experiment("named", REEL, same, plain, about("reel")) is None


def test_unexplained_error_selects_the_experiment_that_excites_it():
    seen = records(REEL + CoulombFriction(torque_Nm=0.05))
    noise = noise_floor(seen)
    where = localise(seen, [BaseNumbers.of(REEL, m) for m in seen], noise)
    assert where.blocks[0].regime.name.startswith("velocity")
    found = next_experiment("unknown", REEL, {}, Evidence(seen, noise, where, 5.0))
    assert found.separation is None
    assert where.blocks[0].regime.name in found.sentence
    low, high = rig_of(REEL, seen).limits.tension_min_N, rig_of(REEL, seen).limits.tension_max_N
    assert low <= found.trial.profile.extremes_N[0] < found.trial.profile.extremes_N[1] <= high


@pytest.fixture
def trial(tmp_path):
    profile = TriangleProfile(15.0, 5.0, 1.0, 2.2, 0.2, loop="open")
    return TrialFile("slow", profile, why="because").write(tmp_path)


def test_trial_file_runs_on_a_rig_and_its_record_joins_the_data(trial, tmp_path, capsys):
    data = tmp_path / "data"
    with served("simulated") as rig:
        for _ in range(2):  # a trial id never runs twice, the same file may
            assert run(["run-experiment", str(trial), rig.endpoint, "--data", str(data)]) == 0
    assert "the trial ran to its end" in capsys.readouterr().out
    read = read_measurements(data)
    assert len(read.measurements) == 2
    assert not read.findings
    first = read.measurements[0]
    asked = read_trial(trial).profile
    assert (first.loop, first.profile, first.preload_N) == ("open", "triangle", 15.0)
    np.testing.assert_array_equal(first.setpoint_N, asked.setpoint(632.0))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda values: values.pop("profile"), "profile: Field required"),
        (lambda values: values.update(colour="red"), "colour"),
        (lambda values: values["profile"].update(kind="square"), "profile: .*square"),
        (lambda values: values["profile"].update(period_s=-1.0), "period_s is -1.0"),
        (lambda values: values["profile"].update(amplitude_N=90.0), "outside the rig's range"),
        (lambda values: values.update(name="../x"), "may hold only letters"),
    ],
)
def test_unsuitable_trial_file_is_refused(trial, tmp_path, capsys, change, said):
    values = json.loads(trial.read_text())
    change(values)
    trial.write_text(json.dumps(values))
    wanted = ["run-experiment", str(trial), "plants:reference_reel", "--data", str(tmp_path / "d")]
    assert run(wanted) == InvalidInput.exit_code
    assert re.search(said, capsys.readouterr().err)
    assert not (tmp_path / "d").exists()


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
    plain, tmp_path, monkeypatch, capsys
):
    (m, *_), seen = plain.measurements, []
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


def test_complete_model_is_unchanged_over_the_link(tmp_path, capsys):
    with served("simulated") as rig:
        wanted = ["improve-model", rig.endpoint, "--folder", str(tmp_path / "x"), "--json"]
        wanted += ["--model-trials", "20", "--trials", "4"]
        assert run(wanted) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["effects"], len(told["rounds"])) == ("none", [], 1)
    for costs in told["costs"]:
        assert costs["improved"] == pytest.approx(costs["measured"], rel=0.03)


def watched(rig, at, action):
    """The rig, whose trial of that number is replaced; and the ids of the trials it runs."""
    real, ids = rig.run, []

    def run(request):
        ids.append(request.trial_id)
        return action(request, real) if len(ids) == at else real(request)

    rig.run = run
    return ids


def stop(*_):
    raise KeyboardInterrupt


FEWER = {
    "effects": FEW,
    "rounds": 1,
    "tuning": ImprovementOptions(model_trials=5, rig_trials=2, watch=None),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return plants.improve(REEL.rig(), REEL, folder=tmp_path_factory.mktemp("whole"), **FEWER)


def test_page_of_an_improvement_has_its_costs_last_diagnosis_and_tuning(whole):
    text = render(page(whole))
    for shown in (*whole.rows()[0][1:2], whole.diagnosis.heading().partition(";")[0], "Diagnoses"):
        assert str(prose(shown)) in text
    assert ("Tuning on the rig" in text) == (whole.tuning is not None)
    assert whole.heading() in repr(whole)


@pytest.mark.parametrize("at", [3, 16])  # among the experiments, and in the rig's tuning
def test_interrupted_improvement_continues_where_it_stopped(whole, tmp_path, at):
    rig = REEL.rig()
    live, ids = rig.describe().gains, watched(rig, at, stop)
    with pytest.raises(Stopped, match="stopped") as stopped:
        plants.improve(rig, REEL, folder=tmp_path / "x", **FEWER)
    assert stopped.value.description.gains == live
    assert stopped.value.folder == tmp_path / "x"
    assert str(tmp_path / "x") in stopped.value.again
    with pytest.raises(InvalidInput, match="another model"):
        plants.improve(rig, plants.reference_reel(drum_inertia_kg_m2=3e-3), folder=tmp_path / "x")
    found = plants.improve(rig, REEL, folder=tmp_path / "x", **FEWER)
    ids.remove(ids[at - 1])  # that which was interrupted before it ran
    assert len(ids) == len(set(ids))
    assert [c.measured for c in found.costs] == [c.measured for c in whole.costs]
    assert found.tuning.gains == whole.tuning.gains
    with pytest.raises(InvalidInput, match="finished"):
        plants.improve(rig, REEL, folder=tmp_path / "x", **FEWER)


def ended(flags, reason):
    def action(request, real):
        record = real(request)
        last = record.flags.copy()
        last[-1] = flags
        return replace(record, outcome=Outcome.INTERRUPTED, reason=reason, flags=last)

    return action


def runner(rig, folder):
    """Trials on a rig that says it moves."""
    about = replace(rig.describe(), simulated=False)
    return ExperimentRunner(rig, about, folder, "now", lambda _: None)


def test_trial_that_was_late_is_repeated(tmp_path):
    rig = REEL.rig()
    ids = watched(rig, 1, ended(LATE | GUARD, "3 late samples in a row"))
    record = runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    assert record.outcome is Outcome.DONE
    assert ids == ["step-now-00000", "step-now-00000.1"]


def test_trial_interrupted_on_a_moving_rig_is_repeated_only_by_a_second_call(tmp_path):
    rig = REEL.rig()
    ids = watched(rig, 1, ended(GUARD, "no heartbeat"))
    with pytest.raises(Interrupted, match="check the rig"):
        runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    assert runner(rig, tmp_path).trial("step", GAINS, REEL.profile).outcome is Outcome.DONE
    assert ids == ["step-now-00000", "step-now-00000.1"]


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


def test_rig_known_by_its_linear_model_keeps_its_effort_per_ampere(tmp_path):
    short = SHORT._replace(model_trials=10, rig_trials=2)
    found = plants.improve(
        PLANT_20_N_A.rig(seed=3), folder=tmp_path / "x", effects=FEW, tuning=short
    )
    assert found.diagnosis.verdict == "none"
    assert found.model.newtons_per_ampere == 20.0
    for one in found.costs:
        assert one.error_improved < 0.05
    plants.save_model(found.model, tmp_path / "m.toml")
    assert plants.load_model(tmp_path / "m.toml").newtons_per_ampere == 20.0


@pytest.mark.parametrize("plant", [PLANT_20_N_A, REEL, plants.unloaded_reel()])
def test_model_at_a_rig_has_its_effort_per_ampere(plant):
    about = replace(plant.describe("rig", None), newtons_per_ampere=31.0)
    at = at_rig(plant, about)
    assert at.newtons_per_ampere == pytest.approx(31.0)
    assert at.controller.output_max_N == pytest.approx(plant.controller.output_max_N)


def test_experiments_of_a_slow_plant_are_longer():
    rig = replace(
        about("reel"),
        settling_time_s=5.0,
        linear_model=None,
        limits=RigLimits(0.0, 100.0, 300.0),
        step=StepProfile(20.0, 10.0, 1.0, 30.0),
    )
    durations = [one.profile.duration_s for one in initial_experiments(rig)]
    assert sum(durations) > 4.0 * sum(
        one.profile.duration_s for one in initial_experiments(about("reel"))
    )


def test_trial_that_failed_in_the_rigs_program_is_asked_for_under_a_new_id(tmp_path):
    """A rig's ledger answers with the same refusal for ever."""
    rig = REEL.rig()
    real = rig.run

    def run(request):
        if request.attempt == 0:
            raise RigError("it stopped before the trial began")
        return real(request)

    rig.run = run
    with pytest.raises(RigError, match="before the trial began"):
        runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    rig.has_failed = lambda request: request.attempt == 0
    with pytest.raises(Interrupted, match="before the trial began"):
        runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    assert runner(rig, tmp_path).trial("step", GAINS, REEL.profile).outcome is Outcome.DONE


def test_stopped_command_says_by_which_one_it_is_continued(tmp_path, monkeypatch, capsys):
    asked = []

    def improve(rig, *_, folder, **__):
        asked.append(folder)
        raise Stopped(rig.describe(), folder, "the same call")

    monkeypatch.setattr(module, "improve", improve)
    given = ["improve-model", "plants:reference_reel", "--model", "plants:reference_reel"]
    assert run([*given, "--folder", str(tmp_path / "x")]) == 130
    again = capsys.readouterr().err.strip().rpartition("continue with: ")[2]
    assert sorted(shlex.split(again)) == sorted(
        ["estune", *given, "--folder", str(tmp_path / "x")]
    )
    run(shlex.split(again)[1:])
    assert asked == [tmp_path / "x"] * 2
