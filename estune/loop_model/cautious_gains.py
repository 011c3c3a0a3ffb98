"""Gains that hold a plant of which little is known, as a start for better ones."""

import itertools
import math
from collections.abc import Callable

import numpy as np

from estune.core.gains import Gains

SENSITIVITY_MAX = 1.3
"""Largest Ms of cautious gains: a gain margin of 4.3 at least."""


def cautious_gains(
    size: float, settling_time_s: float, safe: Callable[[Gains], bool]
) -> Gains | None:
    """A slow PI with a little D and setpoint filter, so that all four are tuned; None without one.

    Args:
        size: Gain of the plant at the frequency of the settling time.
        settling_time_s: Settling time a good tuning can reach.
        safe: Whether the loop with these gains has margins enough.
    """
    if not (math.isfinite(size) and size > 0.0):
        return None
    slow = 2.0 * math.pi / settling_time_s  # rad/s
    # A plant that integrates tolerates little integral action, at any P.
    for P, share in itertools.product(0.5 / size / 2.0 ** np.arange(20), (0.5, 0.125, 0.03)):
        gains = Gains(
            float(P), float(P) * slow * share, 0.01 * float(P) * settling_time_s,
            0.01 * settling_time_s,
        )  # fmt: skip
        if safe(gains):
            return gains
    return None
