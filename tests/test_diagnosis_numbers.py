"""The numbers that decide in the diagnosis stand in one table, and can be replaced."""

from unittest import mock

import numpy as np

from experiments.diagnosis_numbers.__main__ import fits_made_once
from experiments.diagnosis_numbers.numbers import numbers, outside, replaced
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary
from plants.diagnosis.search import least_squares, model_fitter
from plants.diagnosis.search.decide import decide

NOTHING = frozenset[str]()
BASE = ModelSummary(NOTHING, NOTHING, 0, 2.0, 0)
"""A base model that leaves twice the power of the noise."""


def test_each_number_of_the_table_is_used():
    assert not [n.name for n in numbers() if not n.uses]


def test_no_number_outside_the_table_decides():
    assert not outside()


def test_number_with_a_name_is_found_alone_or_among_others(tmp_path):
    lines = [
        "FOLDS, STRETCHES = 4, 32",
        "FINER = (0.7, 0.2)",
        "SIZES: list[float] = [3.0]",
        "GRID = linspace(0.02, 0.9, LEVELS)",
    ]
    units = 'UNITS = {"degrees": 57.3}'
    (tmp_path / "one.py").write_text("\n".join([*lines, units, "NAMES = ('a', 'b')"]))
    assert {found.partition("  ")[2] for found in outside(tmp_path)} == set(lines)


def test_number_of_the_table_is_replaced_while_the_context_lasts():
    (number,) = (n for n in numbers() if n.name == "nothing")
    assert decide(BASE, []).verdict == "unknown"
    with replaced({number: 2.0 * CONSTANTS.nothing}):
        assert decide(BASE, []).verdict == "none"
    assert decide(BASE, []).verdict == "unknown"


def test_fit_is_made_again_only_from_other_values_or_options():
    start = np.zeros(2)
    with mock.patch.object(least_squares, "fit") as made, fits_made_once({}):
        for over in (np.ones(2), np.ones(2), np.full(2, 2.0), None):
            model_fitter.fit(made, start, tolerance=1e-4, over=over)
        model_fitter.fit(made, start + 1.0, tolerance=1e-4, over=None)
    assert made.call_count == 4
