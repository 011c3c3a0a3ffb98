"""From an emulated machine with hidden friction to a remedy that is proven, by commands alone."""

import json
import re

import pytest

from estune.cli import run
from estune.hardware import read_config
from estune.remote import zenoh
from experiments.virtual_loop import virtual_rig
from plants import load_model

pytestmark = pytest.mark.slow


@pytest.fixture
def commands(tmp_path, monkeypatch, capsys):
    """Runs a command in a folder of its own; its output, and its exit code."""
    monkeypatch.chdir(tmp_path)

    def do(*words: object) -> tuple[str, int]:
        code = run([str(word) for word in words])
        return capsys.readouterr().out, code

    return do


def test_friction_of_an_emulated_machine_is_named_remedied_and_proven(commands, tmp_path):
    example, _ = commands("serve-hardware", "--example", "--hidden", "coulomb")
    (tmp_path / "my-rig.toml").write_text(example)
    (tmp_path / "reel.toml").write_text(commands("explain", "--example")[0])
    rig = virtual_rig(read_config("my-rig.toml"))
    with rig, zenoh.serve(rig, "tcp/127.0.0.1:0", ledger=tmp_path / "my-rig.ledger") as server:
        at = server.endpoint
        assert commands("tune", at, "--tracking", "--run", "one", "--quiet")[1] in (0, 11)
        assert commands("export", "one", "--csv", "--per-trial", "--out", "records")[1] == 0
        explain = ("explain", "--model", "reel.toml", "--quiet", "--data")
        found = json.loads(commands(*explain, "records", "--json")[0])
        assert [one["name"] for one in found["effects"]] == ["coulomb_friction"]
        (tmp_path / "diagnosis.json").write_text(json.dumps(found))
        shown, code = commands("remedy", "diagnosis.json", "--rig", "my-rig.toml")
        assert code == 0
        assert float(re.search(r"\+coulomb_Nm = (\S+)", shown)[1]) == pytest.approx(0.05, rel=0.1)
        shown, code = commands("prove", "coulomb_friction.remedy.json", at, "--yes", "--trials", 0)
        assert (code, shown.partition(":")[0]) == (0, "PROVEN")
        short = ("--rounds", 2, "--trials", 4, "--model-trials", 8, "--quiet")
        improve = ("improve-model", at, "--model", "reel.toml", "--folder", "improved")
        assert commands(*improve, *short, "--save", "better.toml")[1] == 0
        assert "coulomb_friction" in {effect.name for effect in load_model("better.toml").effects}
        assert commands(*explain, "improved/data")[1] in (0, 9)
