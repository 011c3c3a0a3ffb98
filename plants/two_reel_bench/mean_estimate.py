"""Mean of independent estimates with Student's interval."""

import numpy as np

from estune.core.quantities import FloatArray
from plants.identify.estimate import Estimate

SIGNIFICANCE_LEVEL = 0.01
"""Significance level of hypothesis tests."""


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
