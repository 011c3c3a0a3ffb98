"""Every numbered equation of the paper is implemented once, checked, and listed."""

import pytest

from tests.equations import NUMBERS, TABLE, checks, implementations, table


@pytest.mark.parametrize("number", NUMBERS)
def test_equation_has_one_docstring_and_a_check(number):
    assert len(implementations().get(number, [])) == 1
    assert checks().get(number)


def test_equation_table_is_up_to_date():
    assert TABLE.read_text("utf-8") == table(), "run: ./dev python -m tests.equations"
