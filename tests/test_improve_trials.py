"""Trials of an improvement: none runs twice, one without information is repeated."""

import shlex
import tomllib
from dataclasses import replace

import pytest

import plants
from estune.cli import run
from estune.errors import Interrupted, InvalidInput, RigError
from estune.hardware.config import config_from
from estune.run.loop import Stopped
from estune.support.html_page import prose, render
from estune.trial import GUARD, LATE, Outcome, record_frame
from experiments.virtual_loop import virtual_rig
from plants.emulator import RIG_FILE
from plants.improvement import improve as module
from plants.improvement.page import page
from plants.improvement.result import OWN, REACHED, TUNED, Costs
from plants.improvement.tuning import ImprovementOptions
from tests.support_improve import FEW, GAINS, REEL, runner, watched


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


@pytest.mark.usefixtures("undrawn")
def test_page_of_an_improvement_has_its_costs_last_diagnosis_and_tuning(whole):
    text = render(page(whole))
    for shown in (*whole.rows()[0][1:2], whole.diagnosis.heading().partition(";")[0], "Diagnoses"):
        assert str(prose(shown)) in text
    assert ("Tuning on the rig" in text) == (whole.tuning is not None)
    assert whole.heading() in repr(whole)
    assert repr(whole).splitlines()[-1] == whole.conclusion


@pytest.mark.parametrize(
    ("reached", "tuned", "said"),
    [
        (2.0, None, "the model's gains cut the measured cost by 50 %; tuning on the rig found"),
        (2.0, 1.0, "cut the measured cost by 50 %; tuning on the rig cut it by 75 % in all"),
        (3.9, None, "do not cut the measured cost beyond its error"),
        (None, None, "no gains of the model could be reached"),
    ],
)
def test_improvement_ends_with_what_model_and_tuning_brought(whole, reached, tuned, said):
    measured = {OWN: 4.0, REACHED: reached, TUNED: tuned}
    costs = [
        Costs(label, GAINS, cost, cost, cost, 0.1)
        for label, cost in measured.items()
        if cost is not None
    ]
    assert said in replace(whole, costs=tuple(costs)).conclusion


@pytest.mark.parametrize(
    "at", [3, pytest.param(16, marks=pytest.mark.slow)]
)  # among the experiments, and in the rig's tuning
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


def test_trial_refused_before_it_began_is_repeated_on_a_rig_that_moves(tmp_path):
    with virtual_rig(config_from(tomllib.loads(RIG_FILE.read_text()), str(RIG_FILE))) as rig:
        lab = runner(rig, tmp_path)
        rig._loop.late = 12  # the guard stops after ten
        record = lab.trial("step", rig.describe().gains, REEL.profile)
    assert (record.trial_id, record.outcome) == ("step-now-00000.1", Outcome.DONE)
    (refused,) = (tmp_path / "records").glob("step-now-00000.record")
    refused = record_frame.decode(refused.read_bytes())
    assert (refused.outcome, refused.time_s.size) == (Outcome.CANCELLED, 0)
    assert "late samples" in refused.reason
