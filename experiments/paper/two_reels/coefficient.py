"""Friction coefficient C_R with its uncertainty, from the mean attenuation ratio."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.estimate import (
    SIGNIFICANCE_LEVEL,
    Estimate,
    student_quantile,
    two_sided_p_value,
)
from experiments.paper.two_reels.friction_ratio import friction_coefficient
from experiments.paper.two_reels.procedure import SWEEPS_MIN

RESOLVED_PROBABILITY = 0.999
"""Confidence level at which a resolved result lies within the tolerance."""

ATTENUATION_MIN = 1e-6


class Uncertainty(NamedTuple):
    """Standard errors of C_R due to the sweeps' repeatability and to the angles."""

    repeatability: float
    angle: float
    sweeps: int

    def half_width(self, probability: float) -> float:
        """Half width of a confidence interval."""
        from scipy.special import ndtri  # noqa: PLC0415  slow to import

        normal = float(ndtri(0.5 + 0.5 * probability))
        width = student_quantile(probability, self.sweeps - 1) * self.repeatability
        return float(np.hypot(width, normal * self.angle))

    def sweeps_needed(self, half_width: float) -> int | None:
        """Sweeps for an interval of this half width; None if the angles alone exceed it."""
        by_angle = self._replace(repeatability=0.0).half_width(RESOLVED_PROBABILITY)
        remaining = half_width**2 - by_angle**2
        if remaining <= 0.0:
            return None
        one_sweep = self.repeatability * float(np.sqrt(self.sweeps / remaining))
        normal = student_quantile(RESOLVED_PROBABILITY, 10**9)
        count = max(SWEEPS_MIN, int((normal * one_sweep) ** 2))
        while student_quantile(RESOLVED_PROBABILITY, count - 1) * one_sweep > np.sqrt(count):
            count += 1
        return count


def mean_coefficient(
    B: Estimate,
    angles_rad: tuple[float, ...],
    angle_error_rad: float,
    sweeps: int,
    probability: float,
) -> tuple[Estimate, Uncertainty]:
    """C_R of two reels in series, from the mean B."""
    angles = np.array(angles_rad)

    def coefficient(ratio: float, turn: float = 0.0) -> float:
        ratio = min(max(ratio, ATTENUATION_MIN), 1.0)
        return float(friction_coefficient(ratio**2, *np.clip(angles + turn, 0.0, np.pi)))

    value, step = coefficient(B.value), B.standard_error
    # One-sided difference: ratios above 1 do not exist.
    repeatability = coefficient(min(B.value, 1.0) - step) - value
    bent = np.clip(angles + angle_error_rad, 0.0, np.pi)
    if np.pi - bent.min() <= angle_error_rad:
        raise InvalidInput(
            f"angles {angles_rad} rad are straight to within their uncertainty of "
            f"{angle_error_rad:g} rad: friction cannot be determined, bend the cable more"
        )
    turned = 0.5 * (coefficient(B.value, angle_error_rad) - coefficient(B.value, -angle_error_rad))
    error = Uncertainty(repeatability, abs(turned), sweeps)
    half = error.half_width(probability)
    total = float(np.hypot(error.repeatability, error.angle))
    return Estimate(value, total, max(value - half, 0.0), value + half, ""), error


def resolution_warnings(
    B: Estimate, C: Estimate, error: Uncertainty, tolerance: float, per_sweep: FloatArray
) -> list[str]:
    """Reasons why C_R is not resolved, with remedies."""
    warnings = []
    half = error.half_width(RESOLVED_PROBABILITY)
    quantile = student_quantile(RESOLVED_PROBABILITY, error.sweeps - 1)
    if B.value + quantile * B.standard_error >= 1.0:
        warnings.append(
            f"the loss 1 - B of {1.0 - B.value:.2g} is not significant at its standard error of "
            f"{B.standard_error:.2g}: no friction can be determined; bend the cable more, raise "
            "the setpoints, or let the gauges warm up"
        )
    elif half > tolerance * C.value:
        what = f"C_R is known to {100.0 * half / C.value:.2g} %, not {100.0 * tolerance:.2g} %"
        needed = error.sweeps_needed(tolerance * C.value)
        warnings.append(
            f"{what}, because of the angles; measure them better, or bend the cable more"
            if needed is None
            else f"{what}; take about {needed} sweeps, read for longer, or bend the cable more"
        )
    order = np.arange(per_sweep.size, dtype=np.float64)
    order -= order.mean()
    slope = float(order @ per_sweep / (order @ order))
    residual = per_sweep - per_sweep.mean() - slope * order
    slope_error = float(np.sqrt(residual @ residual / (per_sweep.size - 2) / (order @ order)))
    if two_sided_p_value(slope, slope_error, per_sweep.size - 2) < SIGNIFICANCE_LEVEL:
        warnings.append(
            f"B drifts by {slope:.2g} per sweep, which invalidates the intervals; let gauges "
            "and eyelets settle, and measure again"
        )
    return warnings
