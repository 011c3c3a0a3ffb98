"""The numbers that decide in the diagnosis are found in its source, and can be replaced."""

from experiments.diagnosis_numbers.numbers import numbers, replaced
from plants.diagnosis.checks import units
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary
from plants.diagnosis.search.decide import decide

NOTHING = frozenset[str]()
BASE = ModelSummary(NOTHING, NOTHING, 0, 2.0, 0)
"""A base model that leaves twice the power of the noise."""


def test_each_number_of_the_table_is_used():
    unused = [n.name for n in numbers() if n.in_table and not n.uses]
    assert not unused


def test_number_of_the_table_is_replaced_while_the_context_lasts():
    (number,) = (n for n in numbers() if n.name == "nothing")
    assert decide(BASE, []).verdict == "unknown"
    with replaced(number, 2.0 * CONSTANTS.nothing):
        assert decide(BASE, []).verdict == "none"
    assert decide(BASE, []).verdict == "unknown"


def test_number_in_a_comparison_is_replaced_while_the_context_lasts():
    number = next(n for n in numbers() if "ratio < 20.0" in n.text and n.value == 20.0)
    edges = [n for n in numbers() if n.text == number.text]
    assert len(edges) == 2
    upper = max(edges, key=lambda n: int(n.name.rpartition(":")[2]))
    assert units._is_far(30.0)
    with replaced(upper, 40.0):
        assert not units._is_far(30.0)
    assert units._is_far(30.0)
