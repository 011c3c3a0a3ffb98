"""Static transparency of a reel: how much its friction hides from a hand on the cable."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import Numbers, checked_array, scalar_or_array
from estune.errors import InvalidInput
from plants.two_reel_bench.contact import checked_angle
from plants.two_reel_bench.friction_ratio import checked_attenuation, checked_coefficient

WEBER_LIMIT = 0.1
"""Share of a force that a hand just notices, Weber's law (Lanzara 1994)."""

Verdict = Literal["transparent", "noticeable", "undecided"]


def log_mean(attenuation_ratios: ArrayLike) -> Numbers:
    """Logarithmic mean of the attenuation ratios over the setpoints.

    Implements (28).

    `chi = mean(ln B_i)`, over the last axis.

    Args:
        attenuation_ratios: B of each setpoint, shape (..., N).

    Raises:
        InvalidInput: a value is not finite or out of its range, or there is none.
    """
    return scalar_or_array(np.asarray(np.mean(np.log(_setpoints(attenuation_ratios)), axis=-1)))


def log_spread(attenuation_ratios: ArrayLike) -> Numbers:
    """The criterion a prototype is to minimise: spread of ln B over the setpoints.

    Implements (27).

    `sqrt(sum((ln B_i - chi)^2) / N)`, over the last axis: zero where friction follows Coulomb's
    law exactly, whatever its size. It is the standard deviation with N, not N - 1.

    Args:
        attenuation_ratios: B of each setpoint, shape (..., N).

    Raises:
        InvalidInput: a value is not finite or out of its range, or there is none.
    """
    return scalar_or_array(np.asarray(np.std(np.log(_setpoints(attenuation_ratios)), axis=-1)))


def friction_share(
    coefficient_R: ArrayLike, attenuation_ratio: ArrayLike, angle_rad: ArrayLike
) -> Numbers:
    """Share of the tension that friction takes, to be below 0.1.

    Implements (29).

    `|F_R|/|T_2| = C_R sqrt(1 + B (B + 2 cos gamma))`, by (20), (19) and (23), and equal to
    `1 - B` for the B that belongs to C_R, so that the limit of 0.1 is `B > 0.9` as the text says.
    The print has `1 + B (1 + 2 cos gamma)`, which contradicts (19): at gamma = pi, without any
    contact force, it would leave `C_R sqrt(1 - B)`.

    Args:
        coefficient_R: Friction coefficient C_R, from 0 to below 1; any shape.
        attenuation_ratio: Attenuation ratio B, above 0, at most 1; broadcasts.
        angle_rad: Angle gamma, 0 to pi; broadcasts.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    C, B = checked_coefficient(coefficient_R), checked_attenuation(attenuation_ratio)
    half = 0.5 * checked_angle(angle_rad)
    # 1 + B^2 + 2 B cos(gamma), without cancelling near gamma = pi.
    return scalar_or_array(np.asarray(C * np.hypot((1.0 + B) * np.cos(half), (1.0 - B) * np.sin(half))))


@dataclass(frozen=True, slots=True)
class StaticTransparency:
    """How transparent a reel is at rest.

    Attributes:
        log_mean: Mean of ln B over the setpoints, (28).
        log_spread: Its spread over the setpoints, (27).
        friction_share: Greatest share of the tension lost over the setpoints, (29).
        friction_share_low: Least that this share may be, at the confidence of the ratios.
        friction_share_high: Most that it may be.
        limit: What a hand just notices.
    """

    log_mean: float
    log_spread: float
    friction_share: float
    friction_share_low: float
    friction_share_high: float
    limit: float = WEBER_LIMIT

    @property
    def verdict(self) -> Verdict:
        """Whether the share is below Weber's limit, above it, or cannot be told from it."""
        if self.friction_share_high < self.limit:
            return "transparent"
        return "noticeable" if self.friction_share_low > self.limit else "undecided"


def static_transparency(
    attenuation_ratios: ArrayLike, low: ArrayLike, high: ArrayLike, limit: float = WEBER_LIMIT
) -> StaticTransparency:
    """Judges the attenuation ratios that were measured over the setpoints.

    Args:
        attenuation_ratios: B of each setpoint, shape (N,).
        low: Lower ends of their confidence intervals, shape (N,).
        high: Upper ends, shape (N,).
        limit: Weber's limit.

    Raises:
        InvalidInput: a value is not finite or out of its range, or the shapes differ.
    """
    B = _setpoints(attenuation_ratios)
    low, high = checked_array("low", low, "", above=0.0), checked_array("high", high, "", above=0.0)
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
