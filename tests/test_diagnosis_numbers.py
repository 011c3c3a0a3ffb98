"""The numbers that decide in the diagnosis stand in one table, and can be replaced."""

from experiments.diagnosis_numbers.numbers import numbers, outside, replaced
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary
from plants.diagnosis.search.decide import decide

NOTHING = frozenset[str]()
BASE = ModelSummary(NOTHING, NOTHING, 0, 2.0, 0)
"""A base model that leaves twice the power of the noise."""


def test_each_number_of_the_table_is_used():
    assert not [n.name for n in numbers() if not n.uses]


def test_no_number_outside_the_table_decides():
    assert not outside()


def test_number_of_the_table_is_replaced_while_the_context_lasts():
    (number,) = (n for n in numbers() if n.name == "nothing")
    assert decide(BASE, []).verdict == "unknown"
    with replaced({number: 2.0 * CONSTANTS.nothing}):
        assert decide(BASE, []).verdict == "none"
    assert decide(BASE, []).verdict == "unknown"
