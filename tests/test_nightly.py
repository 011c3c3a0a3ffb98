"""Claims of the project at validation size; `bash .ci/nightly` runs them.

`tests/support_claims.py` states the claimed rates and the bound of each check; test_experiments.py
applies the same checks to the short forms.
"""

import pytest

from tests.support_claims import CHECKS
from tests.support_experiments import run_experiment

VALIDATION = {
    # Seeds 70 200 to 70 299, the validation block of experiments/hidden_machines/seeds.md.
    "hidden_effects": ("--seed0", "70200", "--cases", "380", "--jobs", "2"),
    "sample_efficiency": ("--seeds", "10", "--jobs", "2"),
    "chaos": ("--faults", "500", "--trials", "1000"),
    "loop_claims": (),
    "margin_watch": (),
    "identification": (),
    "confirmation": (),
}
"""Options of each experiment at validation size."""


@pytest.mark.nightly
@pytest.mark.parametrize("name", VALIDATION)
def test_figures_agree_with_the_claims_at_validation_size(name, tmp_path):
    printed = run_experiment(name, tmp_path, *VALIDATION[name])
    if name in CHECKS:
        CHECKS[name](printed["figures"], printed["targets"])
    else:  # its targets allow for the number of cases
        assert not [key for key, target in printed["targets"].items() if not target["met"]]


def test_validation_covers_every_checked_experiment():
    assert set(VALIDATION) >= set(CHECKS)
