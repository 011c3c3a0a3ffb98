"""The cost of limits of sensitivity and overshoot, by the identified loop."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.optimum import Optimum, RegionSearch, RobustnessLimits
from estune.loop_model.prediction import StepTrial

DEAR = 0.05
"""Price from which softer limits are priced too."""

SOFTER = (1.8, 2.0)
"""Sensitivities that are priced then."""

LEAST = 5e-4
"""Price that is told: below it, it is 0.0 %."""

EXTENT = 1.5
"""Greatest distance of an optimum from the tuned gains, in logarithms. Without limits the optima
of seven families lie within 1.3 of those with them."""


class LimitPrice(NamedTuple):
    """Cost of gains within limits over that without them.

    Attributes:
        softer: Price of each softer limit of Ms; empty unless the price is above `DEAR`.
    """

    price: float
    softer: tuple[tuple[float, float], ...]

    @property
    def sentence(self) -> str:
        """The price in words; empty where it is none."""
        if self.price < LEAST:
            return ""
        softer = [f"; with Ms up to {m:g} by {_lower(own, self.price)}" for m, own in self.softer]
        return (
            "without the limits on Ms and overshoot the model predicts a cost lower by "
            f"{_lower(0.0, self.price)}{''.join(softer)}"
        )


def _lower(one: float, other: float) -> str:
    """By how much a cost with one price is below that with the other."""
    return f"{1.0 - (1.0 + one) / (1.0 + other):.1%}"


def price_of(
    fit: LoopFit,
    trial: StepTrial,
    limits: RobustnessLimits,
    gains_of: Callable[[FloatArray], Gains],
    *,
    at: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    beside: HalfWidths,
) -> LimitPrice:
    """The price of limits about the tuned gains.

    Args:
        gains_of: From coordinates to gains.
        at: Coordinates of the tuned gains, shape (n,).
        bounds: Least and greatest coordinates.
        beside: Half widths of the intervals at the tuned gains, which the search kept, too.
    """

    def best(within: RobustnessLimits) -> Optimum:
        low, high = np.maximum(bounds[0], at - EXTENT), np.minimum(bounds[1], at + EXTENT)
        aimed = within.aimed(beside)
        search = RegionSearch(fit.model, trial, aimed, gains_of, low, high, fit.noise_std)
        return search.minimise([at])

    free = best(RobustnessLimits(None, None, None)).prediction.cost

    def price(within: RobustnessLimits) -> float:
        return max(best(within).prediction.cost / free - 1.0, 0.0)

    least = limits.max_sensitivity or math.inf
    own = price(limits)
    return LimitPrice(
        own,
        tuple(
            (limit, price(replace(limits, max_sensitivity=limit)))
            for limit in SOFTER
            if own > DEAR and limit > least
        ),
    )
