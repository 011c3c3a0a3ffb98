"""Data point of a law: the gains of one finished tuning, with their uncertainty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

CELLS = "cells.csv"
"""File in the folder of a sweep that holds the data points of its laws."""


@dataclass(frozen=True, slots=True)
class TunedGains:
    """The gains tuned at one cable length and tension.

    Attributes:
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


class TunedColumns(NamedTuple):
    """Data points as arrays.

    Attributes:
        gains: Shape (n, 4).
        log_errors: Standard errors of their logarithms, shape (n, 4); nan where unknown.
    """

    length_m: FloatArray
    tension_N: FloatArray
    gains: FloatArray
    log_errors: FloatArray


def tuned_columns(tunings: Sequence[TunedGains]) -> TunedColumns:
    """The arrays of data points, each of which is read once."""
    unknown = (math.nan,) * 4
    rows = (
        (t.length_m, t.tension_N, *t.gains.as_tuple(), *(t.log_errors or unknown)) for t in tunings
    )
    values = np.fromiter(chain.from_iterable(rows), np.float64, 10 * len(tunings))
    table = values.reshape(-1, 10)
    return TunedColumns(table[:, 0], table[:, 1], table[:, 2:6], table[:, 6:])
