"""The command line, as its own processes: main paths, bad input, Ctrl-C."""

import contextlib
import json
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

import estune
from estune.cli import Interrupts, app, run
from estune.cli.approval_prompt import terminal_approval
from estune.errors import RigError
from estune.run.journal import FILE_NAME, Journal
from estune.run.loop import ApprovalRequest
from estune.trial import TrialRequest
from estune.tuners import TUNERS, CostPrediction
from tests.support_runs import START, ArithmeticRig

COMMAND = [sys.executable, "-m", "estune.cli"]
COMMANDS = {
    "demo",
    "serve",
    "rig",
    "tune",
    "resume",
    "list",
    "show",
    "export",
    "export-controller",
    "apply",
    "rigs",
    "paper",
    "explain",
    "match",
}
HERE = Path(__file__).parent.parent
HEAVY = {
    "casadi",
    "control",
    "matplotlib",
    "numpy",
    "pandas",
    "pyarrow",
    "pydantic",
    "scipy",
    "zenoh",
}


def call(*arguments, code=0):
    """Runs a command to its end and gives what it printed."""
    done = subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=HERE,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done


@contextlib.contextmanager
def served(*arguments, ledger: object = "memory") -> Iterator[str]:
    """The endpoint of `estune serve`, which ends with the block."""
    process = subprocess.Popen(
        [*COMMAND, "serve", "--ledger", str(ledger), *arguments],
        cwd=HERE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process.stdout.readline().split()[-1]
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture(scope="module")
def endpoint():
    with served("--set", "cable_length_m=1.1", "--name", "long-reel") as found:
        yield found


@pytest.fixture(scope="module")
def tuned(endpoint, tmp_path_factory):
    """The folder of runs, with one run in it, and what making it printed."""
    folder = tmp_path_factory.mktemp("runs")
    options = ("--trials", 30, "--repeats", 2, "--run", "first", "--folder", folder)
    return folder, call("tune", endpoint, *options)


def test_help_names_every_command_and_loads_nothing_heavy():
    script = (
        "import sys; from estune.cli import run; run(['--help']); "
        f"assert not {HEAVY} & set(sys.modules)"
    )
    shown = subprocess.run(
        [sys.executable, "-c", script], cwd=HERE, capture_output=True, text=True, check=True
    ).stdout
    assert set(re.findall(r"^│ ([\w-]+)", shown, re.MULTILINE)) >= COMMANDS


def test_every_command_has_help_for_every_option(capsys):
    for name in sorted(COMMANDS):
        for argument in app[name].assemble_argument_collection(parse_docstring=True):
            assert argument.parameter.help, f"{name} {argument.name}"
        assert run([name, "--help"]) == 0
        assert capsys.readouterr().out.startswith(f"Usage: estune {name}")


def test_a_plant_of_the_users_own_is_found_in_the_current_folder(tmp_path):
    (tmp_path / "my_reel.py").write_text(
        "import plants\n\n\ndef short():\n    return plants.reference_reel(cable_length_m=0.5)\n"
    )
    script = "from estune.cli import main; main()"
    options = [
        "tune",
        "my_reel:short",
        "--trials",
        "1",
        "--repeats",
        "1",
        "--run",
        "one",
        "--quiet",
    ]
    command = [sys.executable, "-P", "-c", script, *options]
    # One trial finds nothing better than the start, which has an exit code of its own.
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 7
    assert estune.load(tmp_path / "runs" / "one").rig.cable_length_m == 0.5


def test_version_is_the_packages():
    from importlib.metadata import version  # noqa: PLC0415  its only use

    assert call("--version").stdout.strip() == version("estune")


def test_tune_help_lists_every_registered_tuner():
    shown = call("tune", "--help").stdout
    assert all(name in shown for name in TUNERS)


def test_tune_shows_before_and_after_where_it_is_kept_and_its_figure(tuned):
    folder, done = tuned
    assert done.stdout.startswith("TUNED: long-reel, ")
    for label in ("P", "cost η", "rise time", "overshoot", "gain margin", "phase margin"):
        line = next(line for line in done.stdout.splitlines() if line.startswith(label))
        assert len(re.split(r"\s{2,}", line.strip())) == 3, line
    assert str(folder / "first") in done.stdout
    assert (folder / "first" / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "estune apply" in done.stdout
    assert "search" in done.stderr


def test_list_and_show_say_what_the_library_loads(tuned, here):
    folder, done = tuned
    result = estune.load(folder / "first")
    (row,) = json.loads(call("list", "--folder", folder, "--json").stdout)
    assert (row["run"], row["state"], row["trials"]) == ("first", "tuned", result.nfev)
    assert row["cost"] == result.fun
    shown = json.loads(here("show", "first", "--folder", folder, "--json", "--trials"))
    assert list(shown["gains"].values()) == list(result.x)
    assert shown["tuned"]["margins"]["gain_margin"] == result.tuned.margins.gain_margin
    assert [t["cost"] for t in shown["trials"]] == [e.cost for e in result.entries]
    table = call("show", folder / "first").stdout
    assert table.splitlines()[0] == done.stdout.splitlines()[0]


def test_apply_makes_the_gains_live_and_start_puts_the_old_ones_back(tuned, endpoint, here):
    folder, _ = tuned
    result = estune.load(folder / "first")
    done = here("apply", folder / "first", endpoint)
    assert "confirms" in done
    assert f"{result.gains.P:.6g} N/N" in done
    assert str(result.gains) in call("rigs", endpoint).stdout
    here("apply", folder / "first", endpoint, "--start")
    assert str(result.start_gains) in here("rigs", endpoint)


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_export_writes_one_file_per_trial(tuned, form, tmp_path):
    folder, _ = tuned
    done = call("export", "first", "--folder", folder, f"--{form}", "--out", tmp_path)
    trials = estune.load(folder / "first").nfev
    assert len(list(tmp_path.glob(f"*.{form}"))) == trials
    assert done.stdout.startswith(f"{trials} trials")


def test_ctrl_c_stops_says_which_gains_are_live_and_resume_goes_on(tmp_path, here):
    with served("--pace", "0.1") as endpoint:
        options = ["--trials", "6", "--run", "cut", "--folder", str(tmp_path)]
        process = subprocess.Popen(
            [*COMMAND, "tune", endpoint, *options],
            cwd=HERE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            while "baseline" not in process.stderr.readline():
                pass
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=30)
        finally:
            process.kill()
            process.wait()
        assert process.returncode == 130
        stop = said.splitlines()[-1]
        result = estune.load(tmp_path / "cut")
        assert f"reel confirms that its own gains are live: {result.start_gains}" in stop
        assert f"estune resume {tmp_path / 'cut'}" in stop
        assert "Traceback" not in said
        assert str(result.start_gains) in here("rigs", endpoint)
        (row,) = json.loads(here("list", "--folder", tmp_path, "--json"))
        assert row["state"] == "stopped"
        assert "trials" in call("resume", tmp_path / "cut").stdout
    again = estune.load(tmp_path / "cut")
    assert again.verdict.complete
    assert again.entries[: result.nfev] == result.entries


def test_a_rig_can_be_stopped_from_anywhere_and_stays_so_until_cleared(tmp_path, here):
    with served("--name", "drum", ledger=tmp_path / "ledger") as endpoint:
        assert "drum is stopped" in here("estop", endpoint, "--reason", "smoke")
        assert "emergency stop: smoke" in here("rigs", endpoint)
        assert "smoke" in call("tune", endpoint, "--folder", tmp_path, code=4).stderr
    with served("--name", "drum", ledger=tmp_path / "ledger") as endpoint:
        assert "emergency stop: smoke" in here("rigs", endpoint)
        assert "drum is cleared" in here("clear", endpoint)
        assert "idle" in here("rigs", endpoint)


def test_the_demo_tunes_a_reel_in_another_process_and_ends_it(tmp_path):
    done = call("demo", "--trials", 25, "--pace", 0, "--folder", tmp_path)
    assert "TUNED: reel, " in done.stdout
    endpoint = re.search(r"tcp/\S+", done.stdout)[0]
    assert "figure.png" in done.stdout
    call("rigs", endpoint, code=4)


@pytest.fixture
def here(monkeypatch, capsys):
    """Runs a command in this process, and gives what it printed."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def succeed(*arguments):
        assert run(list(map(str, arguments))) == 0
        return capsys.readouterr().out

    return succeed


@pytest.fixture
def arithmetic_run(tmp_path):
    estune.tune(ArithmeticRig(), trials=1, repeats=1, folder=tmp_path, run="one", watch=None)
    return tmp_path / "one"


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs a command that is to be refused, and gives its exit code and its one line."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.syspath_prepend(HERE)

    def refuse(*arguments):
        code = run(list(map(str, arguments)))
        said = capsys.readouterr()
        assert said.err.count("\n") == 1, said.err
        assert said.err.startswith("estune: ")
        return code, said.err

    return refuse


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
        (("--step-N", 0), "the step is 0 N"),
        (("--preload-N", 500), "outside the rig's range"),
        (("--trials", 0), "must be at least 1"),
        (("--eta-max", "nan"), "eta_max is nan"),
        (("--run", "a/b"), "run name 'a/b'"),
        (("--tuner", "magic"), "the tuners are safe_bayesian, "),
        (("--tuner", "newton"), "is now called safe_bayesian"),
        (("--tolerance", "little"), "tolerance: 'little' is not a number"),
        (("--tolerance", "200%"), "tolerance is 2.0; it is a share"),
        (("--ask",), "needs a terminal to ask at"),
        (("--trails", 3), "Did you mean --trials?"),
    ],
)
def test_a_bad_value_is_one_line_with_code_2_and_leaves_no_run(refused, arguments, says, tmp_path):
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
def test_a_target_that_cannot_be_tuned_is_one_line_with_its_code(
    refused, target, code, says, tmp_path
):
    found, said = refused("tune", target, *QUIET, tmp_path)
    assert found == code
    assert says in said


def test_a_run_that_is_not_there_or_of_another_version_is_one_line_with_code_5(
    refused, arithmetic_run
):
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


def test_a_damaged_record_is_one_line_with_code_5_that_names_the_trial(refused, arithmetic_run):
    with contextlib.closing(sqlite3.connect(arithmetic_run / FILE_NAME)) as connection:
        connection.execute("UPDATE trial SET record = substr(record, 1, 100) WHERE number = 0")
        connection.commit()
    code, said = refused("show", arithmetic_run)
    assert (code, "record of trial one-00000 is damaged" in said) == (5, True)


@pytest.mark.parametrize(
    ("said", "answer"), [("y", "yes"), (" No ", "no"), ("maybe", None), ("always", "always")]
)
def test_whoever_sits_at_the_terminal_is_asked_until_they_answer(
    monkeypatch, capsys, said, answer
):
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


def test_an_impatient_second_ctrl_c_does_not_cut_off_the_wait_for_the_rig(capsys):
    interrupts = Interrupts()
    with pytest.raises(KeyboardInterrupt):
        interrupts(signal.SIGINT, None)
    interrupts(signal.SIGINT, None)
    assert "waiting for the rig to confirm its gains" in capsys.readouterr().err
    with pytest.raises(KeyboardInterrupt):
        interrupts(signal.SIGINT, None)


def test_a_rig_lost_while_it_is_being_stopped_is_not_called_confirmed(
    monkeypatch, capsys, tmp_path
):
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
    assert "has not confirmed which gains are live; check it: the rig is gone" in said
    assert said.count("\n") == 1


def test_list_shows_the_other_runs_beside_one_that_cannot_be_read(arithmetic_run, here):
    torn = arithmetic_run.parent / "torn"
    torn.mkdir()
    (torn / FILE_NAME).write_bytes(b"torn" * 100)
    listed = json.loads(here("list", "--folder", arithmetic_run.parent, "--json"))
    states = {row["run"]: row["state"] for row in listed}
    assert states["one"] == str(estune.load(arithmetic_run).ending)
    assert states["torn"].startswith("unreadable: ")


def test_apply_refuses_another_rig_unless_it_is_named(refused, here, arithmetic_run):
    code, said = refused("apply", arithmetic_run, REEL)
    assert code == 4
    assert "--rig simulated-reel" in said
    assert "confirms" in here("apply", arithmetic_run, REEL, "--rig", "simulated-reel")


def test_an_error_of_ours_keeps_its_traceback(monkeypatch, tmp_path):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr("estune.api.load", lambda _: 1 / 0)
    (tmp_path / FILE_NAME).write_bytes(b"")
    with pytest.raises(ZeroDivisionError):
        run(["show", str(tmp_path)])
