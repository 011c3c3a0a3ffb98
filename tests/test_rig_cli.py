"""`estune serve-hardware` and `estune export-controller`, as a user calls them."""

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from estune.cli import run
from estune.errors import RigError
from estune.remote import zenoh
from estune.trial import Outcome, TrialRequest
from plants.emulator import RIG_FILE

COMMAND = [sys.executable, "-m", "estune"]
ROOT = Path(__file__).parents[1]


@pytest.fixture
def call(capsys, monkeypatch):
    """Runs a command in this process, and gives what it printed."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def told(*arguments, code=0):
        assert run(list(map(str, arguments))) == code
        return capsys.readouterr().err

    return told


@contextmanager
def served(file: Path):
    """A rig served from its file: its process and its endpoint."""
    with subprocess.Popen(
        [*COMMAND, "serve-hardware", str(file)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            line = process.stdout.readline()
            assert line, process.stderr.read()
            yield process, line.split()[-1]
        finally:
            process.kill()


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG_FILE.read_text().replace("late_in_a_row = 10", "late_in_a_row = 1000"))
    return path


@pytest.mark.slow
def test_serve_hardware_remembers_trials_over_a_restart(file):
    with served(file) as (process, endpoint), zenoh.connect(endpoint) as rig:
        description = rig.describe()
        assert not description.simulated
        request = TrialRequest("cli", 0, description.gains, description.step)
        assert rig.run(request).outcome is Outcome.DONE
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    assert file.with_suffix(".ledger").exists()
    with served(file) as (_, endpoint), zenoh.connect(endpoint) as rig:
        assert rig.run(request).trial_id == request.trial_id
        assert rig.describe() == description


@pytest.mark.slow
def test_serve_hardware_ends_with_its_dead_loop(file):
    with served(file) as (process, endpoint), zenoh.connect(endpoint, timeout_s=1.0) as rig:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        (loop,) = (int(child) for child in children)
        os.kill(loop, signal.SIGKILL)
        assert process.wait(20) == RigError.exit_code
        assert "its loop has ended, exit code -9" in process.stderr.read()
        with pytest.raises(RigError, match=r"has ended: .*its loop has ended, exit code -9"):
            rig.describe()


def test_serve_hardware_lists_all_faults_of_a_file(file, call):
    text = file.read_text().replace("travel_max_rad = 3.0", "travel_max_deg = 3.0")
    file.write_text(text)
    told = call("serve-hardware", file, code=2)
    assert "guard.travel_max_rad: is missing" in told
    assert "guard.travel_max_deg: " in told
    assert "Traceback" not in told


def test_export_controller_writes_schedule_header(file, tmp_path, call):
    constant = {"form": "constant", "offset": 0.02}
    gains = dict.fromkeys(("P", "D", "setpoint_filter_s"), constant)
    gains["I"] = {"form": "linear", "offset": 50.0, "slope": -18.5}
    stored = {"length_m": [0.5, 1.4], "tension_N": [15.0, 15.0], "gains": gains}
    schedule = tmp_path / "schedule.json"
    schedule.write_text(json.dumps(stored))
    call("export-controller", file, "--c", "--out", tmp_path / "c.c", "--schedule", schedule)
    assert "gains[1] = 50.0 + -18.5 * (length_m);" in (tmp_path / "estune_schedule.h").read_text()
    schedule.write_text(json.dumps(stored | {"length_m": [0.5, 5.0]}))
    told = call("export-controller", file, "--c", "--schedule", schedule, code=2)
    assert "cannot be used at 5 m and 15 N: gain I is -42.5" in told


def test_export_controller_writes_c_of_a_rig_file(file, tmp_path, call):
    out = tmp_path / "controller.c"
    call("export-controller", file, "--c", "--out", out)
    assert "estune_pidf_gains(pidf, 0.4, 12.0, 0.01, 0.03);" in out.read_text()
    assert "--c" in call("export-controller", file, code=2)
    assert "there is no run" in call("export-controller", "nothing", "--c", code=5)
