"""Every experiment runs in its quick form and prints what its readers and programs expect."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TIMED = {"benchmark_link", "benchmark_trials", "catenary", "effects"}
"""Experiments with targets that are ratios of times, which a busy machine may miss."""

OTHERS = {"equations"}
"""Experiments that measure nothing, and have no --json."""


def experiments() -> list[str]:
    files = (ROOT / "experiments").glob("*.py")
    return sorted({file.stem for file in files} - {"__init__"} - OTHERS)


@pytest.mark.slow
@pytest.mark.parametrize("name", experiments())
def test_an_experiment_prints_its_figures_and_meets_its_targets(name):
    command = [sys.executable, "-m", f"experiments.{name}", "--quick", "--json"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    printed = json.loads(done.stdout)
    assert printed["figures"]
    for target in printed["targets"].values():
        assert set(target) == {"value", "limit", "met"}
    if name not in TIMED:
        missed = [key for key, target in printed["targets"].items() if not target["met"]]
        assert not missed
