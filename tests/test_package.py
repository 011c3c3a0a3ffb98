"""The installed package: doctests, version, licence, names, and experiments from a wheel."""

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


def test_wheel_runs_an_experiment_outside_the_checkout(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    subprocess.run(
        [*command, "--no-build-isolation", "--wheel-dir", tmp_path, ROOT], check=True, timeout=300
    )
    (wheel,) = tmp_path.glob("*.whl")
    installed = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    assert all((installed / package / "py.typed").exists() for package in PACKAGES)
    assert list(installed.glob("*.dist-info/licenses/LICENSE"))
    assert list(installed.glob("*.data/data/share/doc/estune/index.md"))
    script = (
        f"import sys; sys.path.insert(0, {str(installed)!r}); sys.argv = ['x', '--help']\n"
        "import experiments.hidden_effects as found, experiments.hidden_machines.machine as m\n"
        f"assert found.__file__.startswith({str(installed)!r}), found.__file__\n"
        "import pathlib; assert pathlib.Path(m.__file__).with_name('machine.c').exists()\n"
        "sys.exit(found.main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "--quick" in done.stdout
