"""A number estimated from data, with its uncertainty."""

import math
from typing import NamedTuple, Self


class Estimate(NamedTuple):
    """An estimate: its standard error, and its confidence interval `low` to `high`."""

    value: float
    standard_error: float
    low: float
    high: float
    unit: str = ""

    @classmethod
    def normal(cls, value: float, error: float, quantile: float, unit: str = "") -> Self:
        """An estimate with a symmetric interval of `quantile` standard errors to either side."""
        half = quantile * error
        return cls(value, error, value - half, value + half, unit)

    @classmethod
    def log_normal(cls, value: float, log_error: float, quantile: float, unit: str) -> Self:
        """An estimate with a symmetric interval of its logarithm."""
        factor = math.exp(quantile * log_error)
        return cls(value, value * log_error, value / factor, value * factor, unit)

    def __str__(self) -> str:
        text = f"{self.value:.5g} {self.unit} ({self.low:.5g} to {self.high:.5g})"
        return text.replace("  ", " ")
