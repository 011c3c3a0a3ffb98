"""Numbers estimated from data, with their uncertainty."""

import math
from typing import NamedTuple, Self

import numpy as np

from estune.core.quantities import FloatArray

SIGNIFICANCE_LEVEL = 0.01
"""Significance level of hypothesis tests."""


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


def student_quantile(probability: float, freedom: int) -> float:
    """Half width of Student's interval in standard errors."""
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    return float(stdtrit(freedom, 0.5 + 0.5 * probability))


def mean_estimate(values: FloatArray, probability: float, unit: str = "") -> Estimate:
    """Mean of two or more independent estimates, with Student's interval."""
    value, error = float(values.mean()), float(values.std(ddof=1)) / float(np.sqrt(values.size))
    return Estimate.normal(value, error, student_quantile(probability, values.size - 1), unit)


def two_sided_p_value(value: float, standard_error: float, freedom: int) -> float:
    """P-value of the hypothesis that the true value is zero."""
    from scipy.special import stdtr  # noqa: PLC0415  slow to import

    if standard_error == 0.0:
        return 1.0 if value == 0.0 else 0.0
    return float(2.0 * stdtr(freedom, -abs(value) / standard_error))
