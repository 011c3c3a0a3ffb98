"""Every number that decides a verdict or the width of an interval, and what it was measured on.

Powers are mean squares of whitened residuals: 1 is the noise floor. `python -m
experiments.diagnosis_constants` draws what each number costs when it is another.
"""

from typing import NamedTuple


class Constants(NamedTuple):
    """The numbers that decide."""

    nothing: float = 1.6
    floor: float = 1.3
    one_more: float = 0.6
    nameless_more: float = 0.8
    named_share: float = 0.8
    incomplete: float = 9.0
    effective: float = 60.0
    form: float = 0.05
    tied: float = 0.3
    shown: float = 0.3
    student: float = 2.6
    form_least: float = 0.003
    form_taken_up: float = 0.3
    coarse: float = 3.0
    line: float = 30.0
    audible: float = 0.5


CONSTANTS = Constants()
