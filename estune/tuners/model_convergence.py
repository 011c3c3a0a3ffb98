"""What the search by the identified loop may still gain, by draws from the loop's posterior."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from estune.loop_model.drawn_optima import draw_optima, equal_range
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.optimum import Optimum
from estune.tuners.interface import ConvergenceEstimate
from estune.tuners.predictions import ComparedTrial, cost_noise, log_of_cost
from estune.tuners.searched_loop import SearchedLoop

ONE_SIDED_95 = 1.645
"""Standard deviations of a normal distribution below which 95 % of it lie."""


WORTH_DRAWING = 0.1
"""Improvement of the model's optimum over the best trial, in the log cost, below which the
remaining improvement is worth estimating."""


def model_convergence(
    loop: SearchedLoop,
    optimum: Optimum,
    beside: HalfWidths,
    trials: Sequence[ComparedTrial],
    seed: int,
) -> ConvergenceEstimate | None:
    """The state of convergence at the optimum of a loop within limits as far inside as `beside`.

    None where the way there is long.
    """
    left = log_of_cost(loop.predicted(loop.base)) - log_of_cost(optimum.prediction)
    close = left < WORTH_DRAWING and optimum.feasible
    if beside.is_wide or not close or loop.holds_back(optimum):
        return None
    space = loop.space
    search = partial(loop.search, beside=beside)
    draws = draw_optima(loop.fit, search, optimum, seed)
    equal = equal_range(search(loop.fit.model), optimum)
    low, high = np.fmin(draws.interval[0], equal[0]), np.fmax(draws.interval[1], equal[1])
    least, most = space.coordinate_bounds
    low, high = np.maximum(low, least), np.minimum(high, most)
    beyond = 0.0
    if loop.surface:
        beyond = ONE_SIDED_95 * loop.surface.deviation(optimum.coordinates)
    ends = (space.point(tuple(x.tolist())) for x in (low, high))
    return ConvergenceEstimate(
        noise=cost_noise(trials),
        remaining_improvement=-math.expm1(-float(np.quantile(draws.gains, 0.95)) - beyond),
        expected_improvement=-math.expm1(-float(np.mean(draws.gains))),
        intervals=tuple(zip(*ends, strict=True)),
        condition=_condition(loop, optimum),
    )


def _condition(loop: SearchedLoop, optimum: Optimum) -> str:
    """What the bound of the remaining improvement does not know."""
    within = []
    if loop.space.at_bound(loop.space.point(tuple(optimum.coordinates.tolist()))):
        within.append("within the bounds of the search")
    left = f"{loop.fit.misfit:.1%}"
    if not loop.fit.is_white and left != "0.0%":
        within.append(f"by a model that leaves {left} of the step unexplained")
    return " and ".join(within)
