"""Checks of experiments' figures against the rates that the project claims, at any sample size.

A check fails by chance with a probability of 0.001 where the claimed rate is just met, whatever
the number of cases; so it serves the short form of an experiment and its validation size.
"""

from collections.abc import Callable, Mapping
from typing import Any

from experiments.sample_efficiency.problems import PROBLEMS
from tests.support_binomial import least_hits, most_misses

Figures = Mapping[str, Any]

DIAGNOSIS_RATES = {
    "exact_name": "single_visible",
    "right_family": "single_visible",
    "two_both_found_of_these": "two_each_visible_alone",
    "intervals_hold_truth": "intervals",
}
"""Rates with a least value, each with the figure that counts its cases."""


def check_diagnosis(figures: Figures, targets: Figures) -> None:
    """Rates of `experiments.hidden_effects` against the limits of its targets."""
    assert figures["errors"] == 0
    for name, count in DIAGNOSIS_RATES.items():
        limit = targets["two_both_found" if name.startswith("two") else name]["limit"]
        n = round(figures[count])
        if n:
            assert round(figures[name] * n) >= least_hits(n, limit), name
    n = round(figures["nothing_hidden"])
    alarms = round(figures["false_alarms"] * n)
    assert alarms <= most_misses(n, targets["false_alarms"]["limit"])


def check_tuner(figures: Figures, _targets: Figures) -> None:
    """Searches by the cost alone in `experiments.sample_efficiency`.

    Nine of ten searches come within 5 % of the optimum within 40 trials; one of a hundred has more
    than one unsafe trial. `experiments.confirmation` has the coverage of the intervals.
    """
    own = [table["safe_bayesian"] for name, table in figures.items() if name in PROBLEMS]
    n = sum(table["seeds"] for table in own)
    assert sum(table["arrived"] for table in own) >= least_hits(n, 0.9)
    assert sum(table["unsafe_repeatedly"] for table in own) <= most_misses(n, 0.01)


def check_chaos(figures: Figures, targets: Figures) -> None:
    """No trial twice and no record lost in `experiments.chaos`.

    Zero of n faults bounds the rate of a violation, at 95 % confidence, by 1 - 0.05^(1/n).
    """
    counted = [name for name, target in targets.items() if target["limit"] == 0]
    assert {"run_twice", "lost_records", "overlapping"} <= set(counted)
    assert not {name: targets[name]["value"] for name in counted if targets[name]["value"]}
    assert sum(figures["faults_by_kind"].values()) == figures["faults"] > 0


def check_loop_claims(figures: Figures, _targets: Figures) -> None:
    """Margins claimed in `experiments.loop_claims`.

    Nine of ten searches within the class of the identified loop end with a claim, and the true
    sensitivity is above the end of its interval in at most one of 200 searches.
    """
    rows = figures["rows"]
    inside = [row for row in rows if row["kind"] == "family"]
    n = sum(row["seeds"] for row in inside)
    assert round(sum(row["claims"] * row["seeds"] for row in inside)) >= least_hits(n, 0.9)
    assert sum(row["broken_claims"] for row in rows) <= sum(row["seeds"] for row in rows) / 200


def check_margin_watch(figures: Figures, targets: Figures) -> None:
    """Nine of ten changes are noticed in time, and no quiet loop is taken for a changed one.

    The target is each change: of a loop with dead time some records show little.
    """
    assert targets["false_alarms"]["met"]
    rows = figures["rows"]
    changes = sum(row["changes"] for row in rows)
    noticed = sum(row["noticed"] * row["changes"] for row in rows)
    assert round(noticed) >= least_hits(changes, 0.9)


CHECKS: dict[str, Callable[[Figures, Figures], None]] = {
    "hidden_effects": check_diagnosis,
    "sample_efficiency": check_tuner,
    "chaos": check_chaos,
    "loop_claims": check_loop_claims,
    "margin_watch": check_margin_watch,
}
"""Check of each experiment whose figures are rates."""
