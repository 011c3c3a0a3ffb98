"""The command line: bad input, damaged runs and interruptions, each with its exit code."""

import contextlib
import json
import shutil
import signal
import sqlite3
import subprocess
import sys
from types import SimpleNamespace

import pytest

import estune
from estune.cli import Interrupts, run
from estune.cli.approval_prompt import terminal_approval
from estune.errors import RigError
from estune.remote.ledger import LEDGER
from estune.run.approval import ApprovalRequest
from estune.run.journal import FILE_NAME, Journal
from estune.run.labels import read_numbers, write_numbers
from estune.support.sqlite import SqliteFile
from estune.trial import TrialRequest
from estune.tuners import CostPrediction
from tests.support_runs import START, ArithmeticRig

REEL = "plants:reference_reel"
QUIET = ("--quiet", "--folder")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--start", "P=-1"), "gain P is -1.0; it must be finite and above zero"),
        (("--start", "P=0"), "above zero"),
        (("--start", "I=nan"), "gain I is nan"),
        (("--start", "D=inf"), "gain D is inf"),
        (("--start", "Q=1"), "there is no gain Q; the gains are P, I, D"),
        (("--start", "P"), "not of the form NAME=VALUE"),
        (("--bounds", "P=10:1"), "P: lower bound 10 is not below upper bound 1"),
        (("--bounds", "P=1"), "write P=LOW:HIGH"),
        (("--bounds", "P=a:b"), "'a' is not a number"),
        (("--settling-time-s", 100), "settling time"),
        (("--step-N", 0), "step_N: must not be zero"),
        (("--preload-N", 500), "outside the rig's range"),
        (("--trials", 0), "trials is 0; it must be finite and 1 or more"),
        (("--eta-max", "nan"), "eta_max is nan"),
        (("--run", "a/b"), "run name 'a/b'"),
        (("--tuner", "magic"), "the tuners are model_based, "),
        (("--tolerance", "little"), "tolerance: 'little' is not a number"),
        (("--tolerance", "200%"), "tolerance is 2.0; it must be finite and from 0 to below 1"),
        (("--ask",), "needs a terminal for its prompt"),
        (("--trails", 3), "Did you mean --trials?"),
    ],
)
def test_tune_refuses_bad_value_with_code_2_and_leaves_no_run(refused, arguments, says, tmp_path):
    code, said = refused("tune", REEL, *arguments, *QUIET, tmp_path)
    assert code == 2
    assert says in said
    assert not list(tmp_path.glob(f"*/{FILE_NAME}"))


@pytest.mark.parametrize(
    ("target", "code", "says"),
    [
        ("nowhere:thing", 2, "there is no module 'nowhere'"),
        ("plants:nothing", 2, "plants has no 'nothing'"),
        ("reel", 2, "neither an endpoint"),
        ("tests.support_targets:unstable", 6, "unsafe on this rig"),
        ("tests.support_targets:diverging", 6, "unsafe on this rig"),
        ("tests.support_targets:misshapen", 3, "measurement"),
        ("tests.support_targets:short", 4, "30 samples"),
        ("tcp/127.0.0.1:9", 4, "estune serve --listen tcp/127.0.0.1:9"),
    ],
)
def test_tune_reports_unusable_target_in_one_line_with_its_code(
    refused, target, code, says, tmp_path
):
    patience = ("--patience", 0.5) if code == 4 and target.startswith("tcp/") else ()
    found, said = refused("tune", target, *patience, *QUIET, tmp_path)
    assert found == code
    assert says in said


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("--listen", "tcp/127.0.0.1"), "endpoint 'tcp/127.0.0.1' is malformed"),
        (("--listen", "tcp/0.0.0.0:0"), "--allow-remote"),
        (("--listen", "tls/127.0.0.1:0"), "needs certificates"),
        (("--set", "cable_length_m=-1"), "cable_length_m"),
        ((), "is that of another server"),
    ],
)
def test_serve_says_what_is_wrong_in_its_settings_before_that_its_ledger_is_taken(
    refused, wrong, says, tmp_path
):
    with SqliteFile.open_writer(tmp_path / "reel.ledger", LEDGER):
        code, said = refused("serve", *wrong, "--ledger", tmp_path / "reel.ledger")
    assert code in (2, 4)
    assert says in said


def test_path_that_the_system_refuses_is_one_line(refused):
    code, said = refused("suggest", "9" * 400)
    assert (code, "File name too long; give another path" in said) == (2, True)


def test_missing_locked_newer_or_torn_run_exits_with_code_5(refused, arithmetic_run):
    assert refused("show", "nothing", "--folder", arithmetic_run.parent)[0] == 5
    with Journal.open(arithmetic_run, write=True):
        code, said = refused("resume", arithmetic_run)
        assert (code, "another process" in said) == (5, True)
    with contextlib.closing(sqlite3.connect(arithmetic_run / FILE_NAME)) as connection:
        connection.execute("PRAGMA user_version=99")
    code, said = refused("show", arithmetic_run)
    assert (code, "version 99" in said) == (5, True)
    (arithmetic_run / FILE_NAME).write_bytes(b"torn" * 100)
    for command in ("show", "resume"):
        code, said = refused(command, arithmetic_run)
        assert (code, "damaged" in said) == (5, True)


def test_damaged_record_exits_with_code_5_and_names_the_trial(refused, arithmetic_run):
    with contextlib.closing(sqlite3.connect(arithmetic_run / FILE_NAME)) as connection:
        connection.execute("UPDATE record SET frame = substr(frame, 1, 100) WHERE number = 0")
        connection.commit()
    code, said = refused("show", arithmetic_run)
    assert (code, "record of trial one-00000 is damaged" in said) == (5, True)


@pytest.mark.parametrize(
    ("said", "answer"), [("y", "yes"), (" No ", "no"), ("maybe", None), ("always", "always")]
)
def test_terminal_approval_prompts_until_answered(monkeypatch, capsys, said, answer):
    lines = iter([said])

    def type_in(_prompt):
        try:
            return next(lines)
        except StopIteration:
            raise EOFError from None

    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("builtins.input", type_in)
    request = TrialRequest("run", 7, START, ArithmeticRig().description.step)
    question = ApprovalRequest(request, CostPrediction(1.5, 1.25, 2.0, explored=False), 3.0)
    if answer is None:  # the answer makes no sense, and nobody is there to give another
        with pytest.raises(KeyboardInterrupt):
            terminal_approval()(question)
    else:
        assert terminal_approval()(question) == answer
    shown = capsys.readouterr().out
    for what in ("trial 7", str(START), "1.5 (1.25 to 2)", "unsafe above 3"):
        assert what in shown


def test_second_ctrl_c_does_not_cut_off_the_wait_for_the_rig(capsys):
    interrupts = Interrupts()
    with pytest.raises(KeyboardInterrupt):
        interrupts(signal.SIGINT, None)
    interrupts(signal.SIGINT, None)
    assert "waiting for the rig to confirm its gains" in capsys.readouterr().err
    with pytest.raises(KeyboardInterrupt):
        interrupts(signal.SIGINT, None)


def test_stop_inside_code_made_from_a_string_ends_with_the_exit_code_of_a_stop(tmp_path):
    stop = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    (tmp_path / "stopping.py").write_text(f"exec({stop!r})\n")
    command = [sys.executable, "-m", "estune", "tune", "stopping:rig", *QUIET, str(tmp_path)]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 130


def test_rig_lost_during_stop_is_not_reported_as_confirmed(monkeypatch, capsys, tmp_path):
    handlers = {}
    monkeypatch.setattr(signal, "signal", handlers.__setitem__)

    class Lost(ArithmeticRig):
        def run(self, _request):
            return handlers[signal.SIGINT](signal.SIGINT, None)

        def abort(self):
            raise RigError("the rig is gone")

    monkeypatch.setattr("estune.run.targets.load", lambda _: Lost())
    assert run(["tune", REEL, *QUIET, str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert "stopped, but the live gains are not confirmed; check the rig: the rig is gone" in said
    assert said.count("\n") == 1


def test_list_shows_the_newest_run_first(arithmetic_run, here, tmp_path):
    for name, begun in (("b", "2026-03-02"), ("a", "2026-01-05"), ("c", "2026-02-01")):
        shutil.copytree(arithmetic_run, tmp_path / "many" / name)
        with Journal.open(tmp_path / "many" / name, write=True) as journal:
            journal.note(created_at=f"{begun}T12:00:00+00:00")
    listed = json.loads(here("list", "--folder", tmp_path / "many", "--json"))
    assert [row["run"] for row in listed] == ["b", "c", "a"]


def test_list_shows_other_runs_beside_an_unreadable_one(arithmetic_run, here):
    torn = arithmetic_run.parent / "torn"
    torn.mkdir()
    (torn / FILE_NAME).write_bytes(b"torn" * 100)
    write_numbers(torn, read_numbers(arithmetic_run))  # of a run whose journal was damaged later
    listed = json.loads(here("list", "--folder", arithmetic_run.parent, "--json"))
    states = {row["run"]: row["state"] for row in listed}
    assert states["one"] == str(estune.load(arithmetic_run).ending)
    assert states["torn"].startswith("unreadable: ")
    last = here("list", "--folder", arithmetic_run.parent).splitlines()[-1]
    assert last == f"torn: {states['torn'].removeprefix('unreadable: ')}"


def test_apply_refuses_another_rig_unless_named(refused, here, arithmetic_run):
    code, said = refused("apply", arithmetic_run, REEL)
    assert code == 4
    assert "--rig simulated-reel" in said
    said = here("apply", arithmetic_run, REEL, "--rig", "simulated-reel", "--backoff", "25%")
    assert "confirms" in said
    assert "any gain margin is 1.33 times as large" in said


def test_programming_error_keeps_its_traceback(monkeypatch, tmp_path):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr("estune.api.load", lambda _: 1 / 0)
    (tmp_path / FILE_NAME).write_bytes(b"")
    with pytest.raises(ZeroDivisionError):
        run(["show", str(tmp_path)])
