"""How well the mean of independent estimates is known."""

import numpy as np

from estune.core.quantities import FloatArray
from plants.identify.estimate import Estimate

SIGNIFICANCE_LEVEL = 0.01
"""A test whose outcome chance alone makes less often than this counts against its hypothesis."""


def student_quantile(probability: float, freedom: int) -> float:
    """Half width of Student's interval in standard errors."""
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    return float(stdtrit(freedom, 0.5 + 0.5 * probability))


def mean_estimate(values: FloatArray, probability: float, unit: str = "") -> Estimate:
    """Mean of independent estimates, two or more, with Student's interval."""
    value, error = float(values.mean()), float(values.std(ddof=1)) / float(np.sqrt(values.size))
    half = student_quantile(probability, values.size - 1) * error
    return Estimate(value, error, value - half, value + half, unit)


def two_sided_p_value(value: float, standard_error: float, freedom: int) -> float:
    """How likely an estimate is to be at least so far from zero by its scatter alone."""
    from scipy.special import stdtr  # noqa: PLC0415  slow to import

    if standard_error == 0.0:
        return 1.0 if value == 0.0 else 0.0
    return float(2.0 * stdtr(freedom, -abs(value) / standard_error))
