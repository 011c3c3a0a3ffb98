"""Parameters of a test of which the first runs by day and the others in the slow lane."""

import pytest


def first_by_day(first, *others):
    return [first, *(pytest.param(other, marks=pytest.mark.slow) for other in others)]
