"""Optima of models drawn from the posterior of an identified loop: what may be left to improve."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.drawn_models import drawn_models, white_factor
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import Optimum, RegionSearch

DRAWS = 6
ITERATIONS = 3
"""Draws, and iterations of the optimum of each: the bound on the improvement is then as after 25,
0.02 to 0.19 % on five families."""


RISE = 0.02
"""Rise of the predicted cost, as a share of it, within which gains are as good: the default of
the tolerance of a search."""

CURVATURE_STEP = 0.05
"""Distance in a logarithm by which slope and curvature of the cost are measured."""


class DrawnOptima(NamedTuple):
    """Optima of drawn models.

    Attributes:
        centre: The optimum of the identified loop, shape (n,).
        gains: What each draw has left to gain there, in the log cost; one where it is unstable.
        optima: Optima of the stable ones, shape (up to draws, n).
    """

    centre: FloatArray
    gains: tuple[float, ...]
    optima: FloatArray

    @property
    def interval(self) -> tuple[FloatArray, FloatArray]:
        """Ends of the 95 % interval of the optimum, by Student's t; shape (n,) each."""
        from scipy.special import stdtrit  # noqa: PLC0415  slow to import

        count = len(self.optima)
        if count < 2:
            return self.centre, self.centre
        half = float(stdtrit(count - 1, 0.975)) * np.std(self.optima, axis=0, ddof=1)
        return self.centre - half, self.centre + half


def equal_range(search: RegionSearch, optimum: Optimum) -> tuple[FloatArray, FloatArray]:
    """Range of each coordinate by itself within which the predicted cost rises by `RISE`.

    By a parabola on either side; to the end of the region where the cost does not rise by as much
    on the way there: a setpoint filter that is short enough acts as none.
    """
    x, here = optimum.coordinates, math.log(optimum.prediction.cost)
    low, high = np.array(search.low, dtype=float), np.array(search.high, dtype=float)
    axes = CURVATURE_STEP * np.eye(x.size)
    reached = search.ends(x)  # all low ends, then all high ones
    search.all_predicted([*(x + side * axis for axis in axes for side in (-1.0, 1.0)), *reached])
    for i, axis in enumerate(axes):
        rises = [math.log(search.predicted(x + side * axis).cost) - here for side in (-1.0, 1.0)]
        bend = (rises[0] + rises[1]) / (2.0 * CURVATURE_STEP**2)
        if not 0.0 < bend < math.inf:
            continue
        for side, end in ((-1.0, low), (1.0, high)):
            there = search.predicted(reached[i if side < 0.0 else i + x.size])
            if math.log(there.cost) - here < RISE:
                continue
            # Towards a limit the cost may fall; the limit ends the way there.
            slope = max(side * (rises[1] - rises[0]) / (2.0 * CURVATURE_STEP), 0.0)
            away = (math.sqrt(slope**2 + 4.0 * bend * RISE) - slope) / (2.0 * bend)
            end[i] = min(max(x[i] + side * away, low[i]), high[i])
    return low, high


def draw_optima(
    fit: LoopFit, search: Callable[[LoopModel], RegionSearch], optimum: Optimum, seed: int
) -> DrawnOptima:
    """Optima of models drawn from the posterior of an identified loop."""
    x, gains, optima = optimum.coordinates, list[float](), list[FloatArray]()
    for model in drawn_models(fit, white_factor(fit), DRAWS, seed):
        own = search(model)
        here = own.predicted(x)
        if not math.isfinite(here.cost):
            gains.append(1.0)
            continue
        # What a draw violates at the centre is the model's doubt and no improvement.
        own = replace(own, limits=own.limits.loosened_to(here))
        drawn = own.minimise([x], iterations=ITERATIONS)
        # A search that leaves the stable region has found nothing better.
        there = drawn.prediction.cost if math.isfinite(drawn.prediction.cost) else here.cost
        gains.append(max(math.log(here.cost / there), 0.0))
        optima.append(drawn.coordinates)
    return DrawnOptima(x, tuple(gains), np.array(optima))
