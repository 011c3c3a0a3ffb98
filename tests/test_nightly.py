"""Claims of the project at the size of a night; `bash .ci/nightly` runs them.

`tests/support_claims.py` states the claimed rates and the bound of each check; test_experiments.py
applies the same checks to the short forms.
"""

import pytest

from tests.support_claims import CHECKS
from tests.support_experiments import run_experiment

VALIDATION = {
    # Of seeds 70 200 to 70 299, the validation block of experiments/hidden_machines/seeds.md.
    "hidden_effects": ("--seed0", "70200", "--cases", "100", "--jobs", "2"),
    "sample_efficiency": ("--seeds", "2", "--jobs", "2"),
    "chaos": ("--faults", "60", "--trials", "120", "--daemon-faults", "28"),
    "loop_claims": ("--seeds", "2", "--random", "4"),
    "margin_watch": ("--quiet", "20", "--repeats", "2"),
    "identification": ("--seeds", "50"),
    "confirmation": ("--runs", "40", "--jobs", "2"),
}
"""Options of each experiment for one night; the claims are made by larger runs of the same."""


@pytest.mark.nightly
@pytest.mark.parametrize("name", VALIDATION)
def test_figures_agree_with_the_claims_at_the_size_of_a_night(name, tmp_path):
    printed = run_experiment(name, tmp_path, *VALIDATION[name])
    if name in CHECKS:
        CHECKS[name](printed["figures"], printed["targets"])
    else:  # its targets allow for the number of cases
        assert not [key for key, target in printed["targets"].items() if not target["met"]]


def test_validation_covers_every_checked_experiment():
    assert set(VALIDATION) >= set(CHECKS)
