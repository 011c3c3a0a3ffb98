"""The installed package: doctests, version, licence, names, and the wheel."""

import doctest
import importlib
import os
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import estune
import plants
from estune.cli import run
from estune.errors import InvalidInput

ROOT = Path(__file__).parents[1]
PACKAGES = ("estune", "plants", "experiments")


def modules_with_examples():
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    with_examples = [path.relative_to(ROOT) for path in paths if ">>>" in path.read_text()]
    return [".".join(path.with_suffix("").parts) for path in with_examples]


@pytest.mark.parametrize("name", modules_with_examples())
def test_docstring_examples_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write a run
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_version_is_that_of_the_distribution():
    assert estune.__version__ == metadata.version("estune")


@pytest.mark.parametrize("package", [estune, plants])
def test_dir_lists_names_that_are_loaded_lazily(package):
    assert set(package.__all__) <= set(dir(package))


@pytest.mark.slow
def test_wheel_has_the_product_alone_and_runs_beside_a_module_of_the_same_name(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    subprocess.run(
        [*command, "--no-build-isolation", "--wheel-dir", tmp_path, ROOT], check=True, timeout=300
    )
    (wheel,) = tmp_path.glob("*.whl")
    installed = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    packages = {path.parent.name for path in installed.glob("*/py.typed")}
    assert packages == {"estune", "plants"}
    assert not (installed / "experiments").exists()
    assert list(installed.glob("*.dist-info/licenses/LICENSE"))
    assert list(installed.glob("*.data/data/share/doc/estune/index.md"))
    own = tmp_path / "own"
    own.mkdir()
    (own / "plants.py").write_text("def my_reel():\n    raise AssertionError\n")
    environment = {**os.environ, "PYTHONPATH": str(installed)}

    def estune_command(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "estune", *arguments],
            cwd=own,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    helped = estune_command("serve", "--help")
    assert (helped.returncode, helped.stderr) == (0, "")
    refused = estune_command("tune", "plants:my_reel")
    assert refused.returncode == InvalidInput.exit_code
    assert "plants.py here is hidden by the installed package plants" in refused.stderr


def test_licences_list_what_is_required_and_needed_by_that(capsys):
    assert run(["licences"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("casadi" in line and "LGPL" in line.upper() for line in lines)
    names = {line.partition(" ")[0].lower() for line in lines}
    assert {"numpy", "pydantic_core"} <= names
    assert not [line for line in lines if line.endswith(": ")]
