"""Data point of a law: the gains of one finished tuning, with their uncertainty."""

import math
from dataclasses import dataclass

from estune.core.gains import Gains
from estune.errors import InvalidInput

CELLS = "cells.csv"
"""File in the folder of a sweep that holds the data points of its laws."""


@dataclass(frozen=True, slots=True)
class TunedGains:
    """The gains tuned at one cable length and tension.

    Attributes:
        label: Name in messages.
        log_errors: Standard errors of (ln P, ln I, ln D, ln tau_F), or None where the tuner gives
            none; infinite for a gain that the tuning does not determine, nan where unknown.
        cost_error: Standard error of the cost; zero where unknown.

    Raises:
        InvalidInput: length or tension is not finite and above zero, or the errors are not four
            numbers of at least zero.
    """

    label: str
    length_m: float
    tension_N: float
    gains: Gains
    log_errors: tuple[float, ...] | None
    cost: float
    cost_error: float
    safe: bool
    converged: bool

    def __post_init__(self) -> None:
        for name, value, unit in (
            ("cable length", self.length_m, "m"),
            ("tension", self.tension_N, "N"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(
                    f"{self.label}: {name} is {value} {unit}; it must be finite and above zero"
                )
        if self.log_errors is None:
            return
        if len(self.log_errors) != 4 or any(error < 0.0 for error in self.log_errors):
            raise InvalidInput(
                f"{self.label}: log_errors are {self.log_errors}; give the standard errors of "
                "ln P, ln I, ln D and ln tau_F, zero or above, or None"
            )
