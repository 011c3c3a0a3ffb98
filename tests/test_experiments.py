"""Every experiment runs in its quick form and prints figures and targets in the stated form."""

import re

import pytest

from experiments.__main__ import experiments, main
from tests.support_claims import CHECKS
from tests.support_experiments import run_experiment

TIMED = {
    "benchmark_trials",
    "decision_time",
    "emergency_stop",
    "jitter",
    "live_page",
    "loop_costs",
    "platform_tracking",
    "scale",
    "tls_flood",
}
"""Experiments whose targets are times or ratios of times, which a busy machine may miss."""

TIMES = "_restored_max_s"
"""Ending of the names of single targets that are times."""

SAMPLED = {
    "batch",
    "confirmation",
    "diagnosis_constants",
    "growing_oscillations",
    "hidden_effects",
    "hidden_remedies",
    "loop_prior",
    "margin_watch",
    "sample_efficiency",
    "service_records",
}
"""Experiments whose targets are shares or means of hundreds of cases: too many to be quick."""

NIGHTLY = {
    "batch",
    "benchmark_trials",
    "chaos",
    "compensation",
    "damaged_records",
    "device_faults",
    "diagnosis_constants",
    "diagnosis_numbers",
    "faulty_rigs",
    "hidden_effects",
    "hidden_remedies",
    "improvement",
    "independent_drives",
    "jitter",
    "joints",
    "live_page",
    "look_alikes",
    "loop_claims",
    "loop_costs",
    "margin_watch",
    "paper",
    "platform_tracking",
    "reference_answers",
    "remedies",
    "sample_efficiency",
    "scale",
    "service_records",
    "small_faults",
    "sweep_law",
    "tls_flood",
}
"""Experiments of ten seconds of a core, or whose targets are times; their subjects have tests of
their own."""


FORM = re.compile(
    r"[^\n]+\?\n\n"
    r"Command: `python -m experiments\.(\w+)[^`]*`\.\n"
    r"Target: [^\n]+(\n[^\n]+)*\.(\n\n.+)?",
    re.DOTALL,
)
"""First lines of an experiment: its question, its command, its target."""


@pytest.mark.parametrize("name", experiments())
def test_experiment_opens_with_its_question_command_and_target(name):
    form = FORM.fullmatch(experiments()[name])
    assert form, f"{name} does not open with a question, `Command: ...` and `Target: ...`"
    assert form[1] == name


def test_experiments_are_listed_with_their_questions(capsys):
    main()
    listed = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert listed.keys() == experiments().keys() >= {"scale", "hidden_effects", "paper"}
    assert all(question.endswith("?") for question in listed.values())


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
