"""What commands say and leave behind where they are refused, stopped or unfinished."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

import plants
from estune.cli import main, run
from estune.remote.zenoh.endpoints import intended_endpoint

REEL = plants.reference_reel()


class Interrupting:
    """A rig at which the operator presses Ctrl-C in one trial."""

    def __init__(self, trial):
        self._rig, self._left = REEL.rig(), trial
        self.abort, self.describe = self._rig.abort, self._rig.describe

    def run(self, request):
        self._left -= 1
        if not self._left:
            raise KeyboardInterrupt
        return self._rig.run(request)


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ("tcp:127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ("tcp://127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ("http://reel.local:7447/", "tcp/reel.local:7447"),
        ("tls:[::1]:7447", "tls/[::1]:7447"),
        ("tpc/127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ("plants:reference_reel", ""),
        ("127.0.0.1:99999", ""),
    ],
)
def test_intended_endpoint_of_what_users_write(written, meant):
    assert intended_endpoint(written) == meant


@pytest.mark.parametrize(
    ("command", "code"),
    [(["tune"], 2), (["discover"], 2), (["serve", "--listen"], 2), (["watch"], 5)],
    ids=["tune", "discover", "serve", "watch"],
)
def test_malformed_endpoint_is_answered_with_the_one_that_was_meant(command, code, capsys):
    assert run([*command, "127.0.0.1:7447"]) == code
    assert "did you mean tcp/127.0.0.1:7447?" in capsys.readouterr().err


def test_tune_on_a_held_rig_leaves_no_run(tmp_path, capsys, monkeypatch):
    held = REEL.rig()
    held.estop("test")
    monkeypatch.setattr(sys.modules[__name__], "held", held, raising=False)
    assert run(["tune", f"{__name__}:held", "--folder", str(tmp_path), "--quiet"]) == 4
    assert "safe state" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_apply_refuses_a_run_that_is_not_finished(tmp_path, capsys, monkeypatch):
    stopped = Interrupting(6)
    monkeypatch.setattr(sys.modules[__name__], "stopped", stopped, raising=False)
    folder = ["--folder", str(tmp_path)]
    assert run(["tune", f"{__name__}:stopped", "--run", "half", "--quiet", *folder]) == 130
    capsys.readouterr()
    assert run(["apply", "half", "tcp/127.0.0.1:1", *folder]) == 4
    assert f"estune resume {tmp_path / 'half'}" in capsys.readouterr().err


def test_tuning_stopped_before_its_first_trial_says_that_no_gains_changed(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("estune.api.tune", interrupted)
    assert run(["tune", "plants:reference_reel"]) == 130
    assert "stopped; no trial was running, so the rig's live gains are" in capsys.readouterr().err


def test_ctrl_c_during_the_imports_ends_with_its_exit_code_and_without_a_traceback(tmp_path):
    stop = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    (tmp_path / "cyclopts.py").write_text(f"exec({stop!r})\n")  # in place of the library
    done = subprocess.run(
        [sys.executable, "-m", "estune"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        check=False,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (130, "estune: stopped before anything was done\n")


@pytest.mark.parametrize("command", ["match", "compare"])
def test_stopped_study_is_continued_by_the_same_command(command, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "one", Interrupting(5), raising=False)
    words = {
        "match": ["match", f"{__name__}:one", "plants:reference_reel", "--quiet"],
        "compare": ["compare", f"{__name__}:one", "--tuners", "otis,model_based", "--quiet"],
    }[command]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["estune", *words])
    assert run(words) == 130
    (folder,) = Path(next(tmp_path.iterdir()).name).iterdir()
    continued = f"continue with: estune {' '.join(words)} --folder {folder}"
    assert continued in capsys.readouterr().err


def test_export_ends_lines_as_unix_does(tmp_path):
    folder = ["--folder", str(tmp_path)]
    assert run(["tune", "plants:reference_reel", "--trials", "1", "--run", "r", *folder]) in (
        0,
        7,
        11,
    )
    assert run(["export", "r", "--csv", *folder]) == 0
    assert run(["export", "r", "--csv", "--per-trial", "--out", str(tmp_path / "x"), *folder]) == 0
    files = [*(tmp_path / "r" / "csv").iterdir(), *(tmp_path / "x").glob("*.csv")]
    assert len(files) > 3
    assert not any(b"\r" in file.read_bytes() for file in files)


@pytest.mark.parametrize(
    "encoding",
    [*(pytest.param(e, marks=pytest.mark.slow) for e in ("cp1252", "latin-1")), "ascii"],
)
def test_output_in_a_poor_encoding_is_plain_text_and_no_traceback(encoding, tmp_path, monkeypatch):
    written = {name: io.BytesIO() for name in ("stdout", "stderr")}
    for name, stream in written.items():
        monkeypatch.setattr(sys, name, io.TextIOWrapper(stream, encoding, write_through=True))
    monkeypatch.setattr(sys, "path", [*sys.path])
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "tune",
                "plants:reference_reel",
                "--trials",
                "1",
                "--quiet",
                "--folder",
                str(tmp_path),
            ]
        )
    assert ended.value.code in (0, 7, 11)
    assert not written["stderr"].getvalue()
    out = written["stdout"].getvalue().decode(encoding)
    assert "cost eta" in out
    assert ("±" in out) is (encoding != "ascii")
    assert "+/-" in out or encoding != "ascii"
