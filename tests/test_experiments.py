"""Every experiment runs in its quick form and prints figures and targets in the stated form."""

import re
from pathlib import Path

import pytest

from tests.support_claims import CHECKS
from tests.support_experiments import run_experiment

ROOT = Path(__file__).parents[1]
TIMED = {
    "benchmark_link",
    "benchmark_trials",
    "diagnosis_scale",
    "emergency_stop",
    "jitter",
    "live_page",
    "platform_tracking",
    "scale",
    "sweep_speed",
}
"""Experiments whose targets are times or ratios of times, which a busy machine may miss."""

TIMES = "_restored_max_s"
"""Ending of the names of single targets that are times."""

SAMPLED = {
    "confirmation",
    "diagnosis_constants",
    "hidden_effects",
    "loop_prior",
    "sample_efficiency",
}
"""Experiments whose targets are shares or means of hundreds of cases: too many to be quick."""

NIGHTLY = {
    "benchmark_link",
    "benchmark_trials",
    "diagnosis_constants",
    "diagnosis_scale",
    "hidden_effects",
    "jitter",
    "live_page",
    "paper",
    "platform_tracking",
    "sample_efficiency",
    "scale",
    "soak",
    "sweep_law",
    "sweep_speed",
    "two_reels",
}
"""Experiments of a minute, or whose targets are times; their subjects have tests of their own."""


def experiments() -> list[str]:
    """Names of the modules and packages that can be run and print results."""
    folder = ROOT / "experiments"
    mains = [*folder.glob("*.py"), *folder.glob("*/__main__.py")]
    return sorted(
        file.parent.name if file.stem == "__main__" else file.stem
        for file in mains
        if re.search(r"def main\(.*print_results\(", file.read_text(), re.DOTALL)
    )


def test_page_of_experiments_names_each_experiment_once_and_no_other():
    page = (ROOT / "docs" / "reference" / "experiments.md").read_text("utf-8")
    named = re.findall(r"^\| `python -m experiments\.(\w+)", page, re.MULTILINE)
    assert sorted(named) == experiments()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.nightly] if name in NIGHTLY else [])
        for name in experiments()
    ],
)
def test_experiment_prints_its_figures_and_meets_its_targets(name, tmp_path):
    printed = run_experiment(name, tmp_path, "--quick")
    assert printed["figures"]
    for target in printed["targets"].values():
        assert set(target) == {"value", "limit", "met"}
    if name in CHECKS:
        CHECKS[name](printed["figures"], printed["targets"])
    if name not in TIMED | SAMPLED:
        missed = [key for key, target in printed["targets"].items() if not target["met"]]
        assert not [key for key in missed if not key.endswith(TIMES)]
