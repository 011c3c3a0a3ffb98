"""The command line: main paths, help; in processes of its own Ctrl-C, restarts, the demo."""

import contextlib
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import pytest

import estune
import plants
from estune.cli import app, main, run
from estune.daemon.config_check import check_file
from estune.hardware import read_config
from estune.remote import zenoh
from estune.run.targets import open_target
from estune.studies.sweep.design import read_design
from estune.trial.tracking import resting_profile, tracking_profile
from estune.tuners import TUNERS
from plants import load_model, reference_reel
from plants.emulator import HIDDEN, RIG_FILE
from plants.emulator.settings import make_board

COMMAND = [sys.executable, "-m", "estune"]
COMMANDS = {
    *("demo", "serve", "serve-hardware", "tune", "resume", "sweep", "match", "list", "show"),
    *("watch", "report", "bridge", "compare", "bench", "suggest", "docs", "licences"),
    *(
        "export",
        "export-controller",
        "apply",
        "remedy",
        "prove",
        "explain",
        "explain-page",
        "records",
        "run-experiment",
        "improve-model",
    ),
    *("discover", "doctor", "estop", "clear", "daemon", "daemon-control", "faults"),
}
REEL = "plants:reference_reel"
HERE = Path(__file__).parent.parent


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
    with zenoh.serve(plants.reference_reel(1.1).rig(name="long-reel")) as server:
        yield server.endpoint


@pytest.fixture(scope="module")
def tuned(endpoint, tmp_path_factory):
    """The folder of runs, with one run in it, and what making it printed."""
    folder = tmp_path_factory.mktemp("runs")
    options = ("--trials", "30", "--repeats", "2", "--run", "first", "--folder", str(folder))
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        patch.object(signal, "signal"),
    ):
        assert run(["tune", endpoint, *options]) == 0
    return folder, out.getvalue(), err.getvalue()


def test_help_names_every_command(capsys):
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    assert set(re.findall(r"^│ (\w[\w-]+)", shown, re.MULTILINE)) == COMMANDS


def test_help_lists_commands_in_groups_and_those_of_packages_by_their_place(tmp_path):
    (tmp_path / "extra.py").write_text(
        'ROWS = [("ours", "extra:run", "Ours.", 131), ("theirs", "extra:run", "Theirs.", -5)]'
    )
    metadata = tmp_path / "extra-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: extra\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[estune.commands]\nextra = extra:ROWS\n")
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{HERE}"}
    shown = subprocess.run(
        [*COMMAND, "--help"], env=environment, capture_output=True, text=True, check=True
    ).stdout
    parts = [part.partition(" ") for part in shown.split("╭─ ")[1:]]
    groups = {title: re.findall(r"^│ (\w[\w-]+)", rest, re.MULTILINE) for title, _, rest in parts}
    assert [*groups] == ["Start", "Runs", "Records", "Models", "Rigs", "Service", "Help"]
    assert {"tune", "theirs"} < {*groups["Start"]}
    assert {"explain", "improve-model", "ours"} < {*groups["Models"]}
    assert {"estop", "discover"} < {*groups["Rigs"]}
    assert groups["Service"] == ["daemon", "daemon-control", "faults"]


def test_every_command_has_help_for_every_option(capsys):
    for name in sorted(COMMANDS):
        for argument in app[name].assemble_argument_collection(parse_docstring=True):
            assert argument.parameter.help, f"{name} {argument.name}"
        assert run([name, "--help"]) == 0
        shown = capsys.readouterr().out
        assert shown.startswith(f"Usage: estune {name}")
        for nothing in (
            '[default: ""]',
            "[default: ()]",
            "/.",
        ):  # "/." is a <name> taken for markup
            assert nothing not in shown, f"{name}: {nothing}"


def test_tune_finds_a_user_module_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "my_reel.py").write_text(
        "import plants\n\n\ndef short():\n    return plants.reference_reel(cable_length_m=0.5)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    options = ["--trials", "1", "--repeats", "1", "--run", "one", "--quiet"]
    with pytest.raises(SystemExit) as ended:
        main(["tune", "my_reel:short", *options])
    assert ended.value.code == estune.load("runs/one").ending.exit_code
    assert estune.load("runs/one").rig.cable_length_m == 0.5


def test_version_is_that_of_the_distribution():
    assert call("--version").stdout.strip() == estune.__version__ == version("estune")


@pytest.mark.parametrize("hidden", [None, *HIDDEN])
def test_example_rig_file_is_accepted_and_hides_what_is_asked_for(hidden, here, tmp_path):
    file = tmp_path / "my-rig.toml"
    options = () if hidden is None else ("--hidden", hidden)
    file.write_text(here("serve-hardware", "--example", *options))
    driver = read_config(file).driver.settings
    make_board(driver, 0.0)
    assert len(driver.get("effects", ())) == (hidden is not None)


def test_example_rig_allows_the_trials_of_other_commands():
    about = read_config(RIG_FILE).describe()
    longest = tracking_profile(about.step, about.settling_time_s, about.limits)
    for profile in (longest, resting_profile(about.step, about.settling_time_s)):
        about.limits.check(profile)


def test_example_files_of_sweep_daemon_and_model_are_accepted(here, tmp_path):
    for name, reader in {
        "sweep": read_design,
        "daemon": check_file,
        "explain": load_model,
    }.items():
        file = tmp_path / f"{name}.toml"
        file.write_text(here(name, "--example"))
        assert reader(file)
    reel = load_model(tmp_path / "explain.toml")
    assert reel == reference_reel(**read_config(RIG_FILE).driver.settings["reel"])


def test_setting_with_its_unit_is_refused_with_its_name(refused):
    assert refused("serve", REEL, "--set", "cable_length_m=1.1m", "--ledger", "memory") == (
        2,
        "estune: reel: cable_length_m is '1.1m'; it must be a number, without its unit\n",
    )


def test_serve_hardware_without_a_file_points_to_the_example(refused):
    assert refused("serve-hardware") == (
        2,
        "estune: give the rig's file; for one to begin from, use --example\n",
    )


def test_help_mentions_no_page_that_is_not_installed(capsys):
    for name in sorted(COMMANDS):
        run([name, "--help"])
        assert "docs/" not in capsys.readouterr().out, name


@pytest.mark.slow
def test_folder_that_hides_an_installed_package_is_named(tmp_path):
    hiding = tmp_path / "plants" / "__init__.py"
    hiding.parent.mkdir()
    hiding.touch()
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{HERE}"}
    options = {"cwd": hiding.parent, "env": environment, "text": True, "capture_output": True}
    done = subprocess.run([*COMMAND, "list"], **options, check=False)
    assert done.returncode == 0
    assert f"{hiding} hides the installed package plants; rename" in done.stderr
    done = subprocess.run([*COMMAND, "tune", REEL], **options, check=False)
    assert done.returncode == 2
    assert f"no 'reference_reel'; {hiding} hides the" in done.stderr.splitlines()[-1]


def test_tune_help_lists_every_registered_tuner(here):
    shown = here("tune", "--help")
    assert all(name in shown for name in TUNERS)


def test_tune_prints_comparison_run_folder_and_figure(tuned):
    folder, out, err = tuned
    assert out.startswith("TUNED: long-reel, ")
    for label in ("P", "cost η", "rise time", "overshoot", "gain margin", "phase margin"):
        line = next(line for line in out.splitlines() if line.startswith(label))
        assert len(re.split(r"\s{2,}", line.strip())) == 3, line
    assert str(folder / "first") in out
    assert (folder / "first" / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "estune apply" in out
    assert "search" in err


def test_list_and_show_agree_with_the_library(tuned, here):
    folder, out, _ = tuned
    result = estune.load(folder / "first")
    (row,) = json.loads(here("list", "--folder", folder, "--json"))
    assert (row["run"], row["state"], row["trials"]) == ("first", "tuned", result.nfev)
    assert row["cost"] == result.fun
    shown = json.loads(here("show", "first", "--folder", folder, "--json", "--trials"))
    assert list(shown["gains"].values()) == list(result.x)
    assert shown["tuned"]["margins"]["gain_margin"] == result.tuned.margins.gain_margin
    costs = [None if math.isnan(e.cost) else e.cost for e in result.entries]  # of an excitation
    assert [t["cost"] for t in shown["trials"]] == costs
    table = here("show", folder / "first")
    assert table.splitlines()[0] == out.splitlines()[0]


def test_apply_makes_gains_live_and_start_restores_the_old(tuned, endpoint, here):
    folder, _, _ = tuned
    result = estune.load(folder / "first")
    done = here("apply", folder / "first", endpoint)
    assert "confirms" in done
    assert f"{result.gains.P:.6g} N/N" in done
    assert result.rig.gains_text(result.gains) in here("discover", endpoint)
    assert "--start" in done
    again = here("apply", folder / "first", endpoint, "--backoff", "25%")
    assert "--start" not in again  # the gains of another time
    assert f"keep them: P {result.gains.P:.6g}" in again
    here("apply", folder / "first", endpoint, "--start")
    assert result.rig.gains_text(result.start_gains) in here("discover", endpoint)


def test_gains_that_were_live_are_restored_where_a_run_began_from_others(endpoint, here, tmp_path):
    with open_target(endpoint) as rig:
        live = rig.describe().gains
        others = replace(live, P=0.9 * live.P)
        estune.tune(rig, start=others, trials=2, run="others", folder=tmp_path, watch=None)
        rig.apply(others)
    here("apply", tmp_path / "others", endpoint, "--start")
    with open_target(endpoint) as rig:
        assert rig.describe().gains == live


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_export_writes_one_file_per_trial(tuned, form, tmp_path, here):
    folder, _, _ = tuned
    options = ("--per-trial", f"--{form}", "--out", tmp_path)
    done = here("export", "first", "--folder", folder, *options)
    trials = estune.load(folder / "first").nfev
    assert len(list(tmp_path.glob(f"*.{form}"))) == trials
    assert done.startswith(f"{trials} trials")


@pytest.mark.slow
def test_ctrl_c_reports_live_gains_and_resume_continues(tmp_path, here):
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
        live = result.rig.gains_text(result.start_gains)
        assert f"reel confirms that its own gains are live: {live}" in stop
        assert f"estune resume {tmp_path / 'cut'}" in stop
        assert "Traceback" not in said
        assert result.rig.gains_text(result.start_gains) in here("discover", endpoint)
        (row,) = json.loads(here("list", "--folder", tmp_path, "--json"))
        assert row["state"] == "stopped"
        assert "trials" in here("resume", tmp_path / "cut")
    again = estune.load(tmp_path / "cut")
    assert again.verdict.complete
    assert again.entries[: result.nfev] == result.entries


@pytest.mark.slow
def test_estop_holds_the_rig_across_restarts_until_cleared(tmp_path, here):
    with served("--name", "drum", ledger=tmp_path / "ledger") as endpoint:
        assert "drum is stopped" in here("estop", endpoint, "--reason", "smoke")
        assert "emergency stop: smoke" in here("discover", endpoint)
        assert "smoke" in call("tune", endpoint, "--folder", tmp_path, code=4).stderr
    with served("--name", "drum", ledger=tmp_path / "ledger") as endpoint:
        assert "emergency stop: smoke" in here("discover", endpoint)
        assert "drum is cleared" in here("clear", endpoint)
        assert "idle" in here("discover", endpoint)


@pytest.mark.slow
def test_demo_tunes_a_reel_in_another_process_and_ends_it(tmp_path):
    done = call("demo", "--trials", 25, "--pace", 0, "--folder", tmp_path)
    assert "TUNED: reel, " in done.stdout
    endpoint = re.search(r"tcp/\S+", done.stdout)[0]
    assert "figure.png" in done.stdout
    call("discover", endpoint, code=4)
