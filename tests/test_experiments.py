"""Every experiment runs in its quick form and prints what its readers and programs expect."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TIMED = {"benchmark_link", "benchmark_trials", "catenary", "effects", "jitter", "sweep_speed"}
"""Experiments whose targets are times or ratios of times, which a busy machine may miss."""

TIMES = ("_restored_max_s", "stop_p99_ms")
"""Endings of the names of single targets that are times."""

SAMPLED = {"confirmation", "hidden_effects", "sample_efficiency"}
"""Experiments whose targets are shares of hundreds of cases; a few cases do not decide them."""


def experiments() -> list[str]:
    """The modules and packages that can be run and print results."""
    folder = ROOT / "experiments"
    mains = [*folder.glob("*.py"), *folder.glob("*/__main__.py")]
    return sorted(
        file.parent.name if file.stem == "__main__" else file.stem
        for file in mains
        if re.search(r"def main\(.*print_results\(", file.read_text(), re.DOTALL)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", experiments())
def test_experiment_prints_its_figures_and_meets_its_targets(name, tmp_path):
    command = [sys.executable, "-m", f"experiments.{name}", "--quick", "--json"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    printed = json.loads(done.stdout)
    assert printed["figures"]
    for target in printed["targets"].values():
        assert set(target) == {"value", "limit", "met"}
    if name not in TIMED | SAMPLED:
        missed = [key for key, target in printed["targets"].items() if not target["met"]]
        assert not [key for key in missed if not key.endswith(TIMES)]
