"""Verdicts over a block of validation seeds; see experiments/hidden_machines/seeds.md.

The block whole is a nightly test.
"""

from functools import cache

import pytest

from experiments.hidden_scores import DiagnosisTask, diagnose
from tests.support_hidden import skip_without_compiler

pytestmark = pytest.mark.slow

FIRST_SEED = 70_200
BLOCK = {"plain": 3, "unloaded": 2, "none": 1, "none_unloaded": 1, "outside": 1}


@pytest.fixture(autouse=True)
def _compiler():
    skip_without_compiler()


@cache
def block():
    """Diagnoses of the block."""
    return [
        diagnose(DiagnosisTask(FIRST_SEED + n, variant))
        for variant, count in BLOCK.items()
        for n in range(count)
    ]


def test_hidden_effects_are_identified_by_name_with_one_miss_at_most():
    rows = [row for row in block() if row.variant in ("plain", "unloaded") and row.visible]
    assert not [row.error for row in block() if row.error]
    assert sum(row.right for row in rows) >= len(rows) - 1


def test_diagnoses_have_no_wrong_names():
    assert not [(row.variant, row.seed, row.found) for row in block() if row.wrong_name]


def test_sound_machines_have_no_false_alarms():
    assert {row.verdict for row in block() if not row.truth} == {"none"}


def test_intervals_hold_the_truth():
    held = [
        one.holds for row in block() if row.right for one in (*row.intervals, *row.calibrations)
    ]
    assert len(held) > 10
    assert sum(held) >= 0.8 * len(held)
