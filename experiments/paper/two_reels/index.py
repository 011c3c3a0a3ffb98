"""Static transparency of a reel: share of a force on the cable that friction hides."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import Numbers, checked_array, scalar_or_array
from estune.errors import InvalidInput
from experiments.paper.two_reels.contact import checked_angle
from experiments.paper.two_reels.friction_ratio import checked_attenuation, checked_coefficient

WEBER_LIMIT = 0.1
"""Just noticeable share of a force, Weber's law (Lanzara 1994)."""

Verdict = Literal["transparent", "noticeable", "undecided"]


def log_mean(attenuation_ratios: ArrayLike) -> Numbers:
    """Logarithmic mean of the attenuation ratios over the setpoints.

    Implements (28).

    `chi = mean(ln B_i)`, over the last axis.

    Raises:
        InvalidInput: a value is not finite or out of its range, or there is none.
    """
    return scalar_or_array(np.asarray(np.mean(np.log(_setpoints(attenuation_ratios)), axis=-1)))


def log_spread(attenuation_ratios: ArrayLike) -> Numbers:
    """Design criterion of a prototype: standard deviation of ln B over the setpoints.

    Implements (27).

    `sqrt(sum((ln B_i - chi)^2) / N)`, over the last axis: zero where friction follows Coulomb's
    law. The divisor is N, not N - 1.

    Raises:
        InvalidInput: a value is not finite or out of its range, or there is none.
    """
    return scalar_or_array(np.asarray(np.std(np.log(_setpoints(attenuation_ratios)), axis=-1)))


def friction_share(
    coefficient_R: ArrayLike, attenuation_ratio: ArrayLike, angle_rad: ArrayLike
) -> Numbers:
    """Share of the tension lost to friction; below 0.1 for a transparent reel.

    Implements (29).

    `|F_R|/|T_2| = C_R sqrt(1 + B (B + 2 cos gamma))`, by (20), (19) and (23). It equals `1 - B`
    for the B of C_R, so that the limit of 0.1 is `B > 0.9` as in the text. The print has
    `1 + B (1 + 2 cos gamma)`, which contradicts (19): it would be `C_R sqrt(1 - B)` at gamma = pi,
    where there is no contact force.
    """
    C, B = checked_coefficient(coefficient_R), checked_attenuation(attenuation_ratio)
    half = 0.5 * checked_angle(angle_rad)
    # 1 + B^2 + 2 B cos(gamma), without cancelling near gamma = pi.
    share = C * np.hypot((1.0 + B) * np.cos(half), (1.0 - B) * np.sin(half))
    return scalar_or_array(np.asarray(share))


@dataclass(frozen=True, slots=True)
class StaticTransparency:
    """Transparency of a reel at rest."""

    log_mean: float  # mean of ln B over the setpoints, (28)
    log_spread: float  # standard deviation of ln B over the setpoints, (27)
    friction_share: float  # maximum share of the tension lost over the setpoints, (29)
    friction_share_low: float  # lower end of its confidence interval
    friction_share_high: float  # upper end
    limit: float = WEBER_LIMIT  # just noticeable share

    @property
    def verdict(self) -> Verdict:
        """Whether the interval of the share is below Weber's limit, above it, or contains it."""
        if self.friction_share_high < self.limit:
            return "transparent"
        return "noticeable" if self.friction_share_low > self.limit else "undecided"


def static_transparency(
    attenuation_ratios: ArrayLike, low: ArrayLike, high: ArrayLike, limit: float = WEBER_LIMIT
) -> StaticTransparency:
    """Transparency from attenuation ratios over the setpoints, with confidence limits, shape (N,).

    Raises:
        InvalidInput: a value is not finite or out of its range, or the shapes differ.
    """
    B = _setpoints(attenuation_ratios)
    low = checked_array("low", low, "", above=0.0)
    high = checked_array("high", high, "", above=0.0)
    if not B.shape == low.shape == high.shape == (B.size,):
        raise InvalidInput(
            f"ratios, low and high have shapes {B.shape}, {low.shape}, {high.shape}; give one "
            "value of each per setpoint"
        )
    worst = int(np.argmin(B))
    return StaticTransparency(
        log_mean(B),
        log_spread(B),
        1.0 - float(B[worst]),
        1.0 - float(high[worst]),
        1.0 - float(low[worst]),
        limit,
    )


def _setpoints(ratios: ArrayLike) -> Numbers:
    B = np.atleast_1d(checked_attenuation(ratios))
    if B.shape[-1] == 0:
        raise InvalidInput("no attenuation ratio was given; measure at one setpoint or more")
    return B
