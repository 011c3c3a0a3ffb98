"""The numbers that decide in the diagnosis are found in its source, and can be replaced."""

import numpy as np

from experiments.diagnosis_numbers.numbers import numbers, replaced
from plants.diagnosis.checks import inner_loop, units
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
    with replaced({number: 2.0 * CONSTANTS.nothing}):
        assert decide(BASE, []).verdict == "none"
    assert decide(BASE, []).verdict == "unknown"


def test_number_with_a_name_is_replaced_while_the_context_lasts():
    number = next(n for n in numbers() if n.name == "checks/units.py:MODEL_OFF")
    with replaced({number: 2.0 * number.value}):
        assert vars(units)["MODEL_OFF"] == 2.0 * number.value
    assert vars(units)["MODEL_OFF"] == number.value


def test_number_in_a_comparison_is_replaced_while_the_context_lasts():
    number = next(n for n in numbers() if "share >= 0.98" in n.text)
    command = np.arange(100.0)
    motion = command + 20.0 * (-1.0) ** command  # explains two thirds of it
    assert inner_loop._gain(command, motion) is None
    with replaced({number: 0.5 * number.value}):
        assert inner_loop._gain(command, motion) is not None
    assert inner_loop._gain(command, motion) is None
