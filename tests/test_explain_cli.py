"""`estune explain`: what it prints and writes, and how it ends."""

import html
import json
import re
from dataclasses import replace

import pytest

import plants
from estune.cli import run
from estune.errors import InvalidInput
from estune.run.results.export import write_record
from estune.run.trial_file import read_trial
from estune.trial import TrialRequest
from plants.diagnosis import explain as module
from plants.diagnosis.experiments.designs import initial_experiments
from plants.diagnosis.result import LIMITED, Limitation
from plants.effects import EFFECTS
from tests.support_diagnosis import NO_BLOCKS, REEL, deciding, diagnosis, nothing_found

HOSE = """
from dataclasses import dataclass, replace
from typing import ClassVar
from plants.effects import Effect, Port, parameter


@dataclass(frozen=True)
class Spring(Effect):
    name: ClassVar[str] = "rewind_spring"
    title: ClassVar[str] = "spring that rewinds the drum"
    appearance: ClassVar[str] = "less current than the tension takes"
    port: ClassVar[Port] = Port.DRUM
    torque_Nm: float = parameter(0.05, low=0.0, high=1.0, unit="N m", neutral=0.0)
"""


@pytest.fixture
def asked(monkeypatch):
    """What the command asked the library for; the answer is a made-up diagnosis."""
    calls = []

    def explain(model, records, *, effects=None, **_):
        calls.append({"model": model, "records": records, "effects": effects})
        return diagnosis()

    monkeypatch.setattr(module, "explain", explain)
    return calls


def command(*arguments):
    return run(["explain", "--model", "plants:reference_reel", "--data", "runs", *arguments])


@pytest.mark.usefixtures("asked")
def test_remedies_are_predicted_for_the_gains_that_are_asked_for(capsys):
    assert command("--gains", "P=0.9,I=25") == 0
    assert "predictions for the gains P=0.9,I=25,D=0,F=0." in capsys.readouterr().out
    assert command("--gains", "I=25") != 0
    assert "P is missing" in capsys.readouterr().err


def test_terminal_shows_verdict_error_parameters_and_file_issues(asked, capsys):
    assert command() == 0
    shown = capsys.readouterr().out
    made = diagnosis()
    assert shown.startswith(made.heading())
    for sentence in (made.effects[0].sentence, *(str(f) for f in made.findings)):
        assert sentence in shown
    assert re.search(r"error of short predictions, rms +0\.66 N +0\.58 N +0\.047 N", shown)
    assert re.search(r"eyelet_friction +attenuation +0\.9310 +0\.9279 to 0\.9341", shown)
    assert re.search(r"not excited +backlash, drum_eccentricity;", shown)
    assert "--model plants:reference_reel --data runs --report" in shown
    assert asked == [{"model": REEL, "records": asked[0]["records"], "effects": None}]


def test_verdict_is_shown_even_if_the_report_cannot_be_written(
    asked, capsys, monkeypatch, tmp_path
):
    assert command("--report", str(tmp_path)) == 2
    assert not asked  # refused before the search
    assert f"{tmp_path} is a folder" in capsys.readouterr().err

    def full(*_):
        raise InvalidInput("the disk is full")

    monkeypatch.setattr("plants.diagnosis.report.diagnosis.Diagnosis.report", full)
    assert command("--report", str(tmp_path / "page.html")) == 2
    shown = capsys.readouterr()
    assert shown.out.startswith(diagnosis().heading())
    assert "the disk is full" in shown.err


def test_json_output_is_one_strict_object(asked, capsys):
    assert command("--json") == 0

    def refuse(constant):
        raise AssertionError(constant)

    told = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert told == json.loads(json.dumps(diagnosis().to_json()))
    assert asked


def test_report_and_model_are_written_and_listed(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(module, "explain", lambda *_, **__: diagnosis(where=NO_BLOCKS))
    page, improved = tmp_path / "out.html", tmp_path / "improved.toml"
    assert command("--report", str(page), "--save", str(improved)) == 0
    shown = capsys.readouterr().out
    assert diagnosis().sentence in page.read_text().replace("&nbsp;", " ")
    assert plants.load_model(improved) == diagnosis().augmented
    assert str(page) in shown
    assert f"estune tune {improved}" in shown


def test_model_may_be_a_file(asked, tmp_path):
    reel = plants.reference_reel(cable_length_m=1.3)
    plants.save_model(reel, tmp_path / "reel.toml")
    assert run(["explain", "--model", str(tmp_path / "reel.toml"), "--data", "runs"]) == 0
    assert asked[0]["model"] == reel


def test_user_effects_join_the_catalogue(asked, tmp_path, monkeypatch):
    (tmp_path / "own_hose.py").write_text(HOSE)
    monkeypatch.syspath_prepend(tmp_path)
    assert command("--effects", "own_hose:Spring") == 0
    names = [effect.name for effect in asked[0]["effects"]]
    assert set(names) >= {*EFFECTS, "rewind_spring"}


def test_terminal_shows_an_unexplained_verdict(monkeypatch, capsys):
    monkeypatch.setattr(module, "explain", lambda *_, **__: nothing_found())
    assert command() == 0
    shown = capsys.readouterr().out
    assert shown.startswith("NO MISSING EFFECT: ")
    assert "with the effects" not in shown


@pytest.mark.parametrize("verdict", ["none", "unknown"])
def test_effects_that_the_model_cannot_have_are_told_where_none_helps(
    monkeypatch, capsys, verdict
):
    why = {"cogging": "it acts at the drum", "backlash": "it never fell"}
    found = replace(
        nothing_found(), verdict=verdict, not_excited=why, not_of_the_plant=frozenset({"cogging"})
    )
    monkeypatch.setattr(module, "explain", lambda *_, **__: found)
    command()
    said = "not tried  cogging: it acts at the drum" in capsys.readouterr().out
    assert said == (verdict == "unknown")


@pytest.mark.parametrize(
    ("by_data", "code", "first"),
    [(False, 9, "WITH RESERVATION, no encoder. "), (True, 10, "WITH RESERVATION, no encoder. ")],
)
def test_limitation_is_in_the_headline_the_json_and_the_exit_code(
    monkeypatch, capsys, by_data, code, first
):
    limits = (Limitation("no_encoder", "no encoder", "no record has an angle", by_data),)
    monkeypatch.setattr(module, "explain", lambda *_, **__: diagnosis(limitations=limits))
    assert command() == code
    assert capsys.readouterr().out.startswith(f"{first}IDENTIFIED: ")
    assert command("--json") == code
    told = json.loads(capsys.readouterr().out)
    assert (told["exit_code"], told["limitations"][0]["kind"]) == (code, "no_encoder")


def test_tuning_is_suggested_only_for_a_model_that_can_be_tuned(monkeypatch, tmp_path, capsys):
    drive = diagnosis(augmented=plants.stage(95.0, 200.0), base_model=plants.stage(95.0, 200.0))
    monkeypatch.setattr(module, "explain", lambda *_, **__: drive)
    assert command("--save", str(tmp_path / "m.toml")) == 0
    assert "estune tune" not in capsys.readouterr().out
    assert plants.load_model(tmp_path / "m.toml").scale.subject == "stage"


def test_deciding_trial_is_shown_and_written(monkeypatch, tmp_path, capsys):
    unsure = diagnosis(
        verdict="ambiguous",
        ambiguous=("coulomb_friction", "dahl_hysteresis"),
        next_experiment=deciding(),
    )
    monkeypatch.setattr(module, "explain", lambda *_, **__: unsure)
    assert command() == 0
    first = capsys.readouterr().out
    assert "Coulomb friction or Dahl hysteresis" in first
    assert deciding().sentence in first
    assert "--data runs --next ." in first
    assert command("--next", str(tmp_path)) == 0
    path = tmp_path / "triangle-slow.trial.json"
    assert f"estune run-experiment {path} RIG --data runs" in capsys.readouterr().out
    assert read_trial(path) == deciding().trial


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--report", "no/where.html"), "no folder no; make it, or give another --report"),
        (("--save", "no/where.toml"), "give another --save"),
        (("--effects", "coulomb_frictoin"), "there is no effect"),
        (("--effects", "json:loads"), "an effect is a class derived from Effect"),
    ],
)
def test_bad_option_is_refused_before_the_work(asked, arguments, words, capsys):
    assert command(*arguments) == InvalidInput.exit_code
    said = capsys.readouterr()
    assert words in said.err
    assert not said.out
    assert not asked


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("nowhere.toml", "No such file"),
        ("plants:no_such_reel", "has no 'no_such_reel'"),
        ("reel", "nor a model file"),
    ],
)
def test_missing_model_is_one_line_with_code_2(asked, model, words, capsys):
    assert run(["explain", "--model", model, "--data", "runs"]) == InvalidInput.exit_code
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not asked


@pytest.mark.slow
def test_hidden_friction_is_identified_beside_a_bad_file(tmp_path, capsys):
    base = plants.reference_reel()
    rig = (base + EFFECTS["coulomb_friction"](torque_Nm=0.03)).rig(seed=4)
    about = rig.describe()
    for number, experiment in enumerate(initial_experiments(about)[1:4]):
        trial = TrialRequest("hidden", number, about.gains, experiment.profile)
        write_record(rig.run(trial), tmp_path / "data")
    (tmp_path / "data" / "bad.csv").write_text("time_s,setpoint_N\n0.0,1.0\nnoon,2.0\n")
    plants.save_model(base, tmp_path / "reel.toml")
    arguments = ["explain", "--model", str(tmp_path / "reel.toml")]
    arguments += ["--data", str(tmp_path / "data"), "--json"]
    improved, page = tmp_path / "improved.toml", tmp_path / "page.html"
    assert run([*arguments, "--save", str(improved), "--report", str(page)]) == LIMITED
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] in {"named", "incomplete", "ambiguous"}
    names = {effect["name"] for effect in told["effects"]} | set(told["ambiguous"])
    assert names & {"coulomb_friction", "stribeck_friction", "dahl_hysteresis"}
    assert told["gap_after_N"] < 0.5 * told["gap_before_N"]
    assert told["where"]["block"] == "force"
    (refused,) = [f for f in told["findings"] if f["level"] == "refused"]
    assert (refused["column"], refused["row"]) == ("time_s", 2)
    assert refused["source"].endswith("bad.csv")
    (effect, *_) = plants.load_model(improved).effects
    assert effect.name in names
    text = html.unescape(page.read_text()).replace("\N{NO-BREAK SPACE}", " ")
    assert refused["sentence"] in text


def test_folder_without_records_is_one_line_with_code_2(tmp_path, capsys):
    arguments = ["explain", "--model", "plants:reference_reel", "--data", str(tmp_path / "none")]
    assert run(arguments) == InvalidInput.exit_code
    said = capsys.readouterr()
    assert str(tmp_path / "none") in said.err
    assert not said.out
