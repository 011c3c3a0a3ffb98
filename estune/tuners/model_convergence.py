"""What the search by the identified loop may still gain, by draws from the loop's posterior."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from estune.loop_model.drawn_optima import draw_optima, equal_range
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import Optimum, RegionSearch
from estune.tuners.interface import ConvergenceEstimate
from estune.tuners.predictions import cost_noise
from estune.tuners.residual_surface import ResidualSurface
from estune.tuners.search_space import SearchSpace

ONE_SIDED_95 = 1.645
"""Standard deviations of a normal distribution below which 95 % of it lie."""


class SearchedLoop(NamedTuple):
    """An identified loop and its optimum.

    Attributes:
        surface: What trials measured beyond the model; None where it stands.
    """

    fit: LoopFit
    search: Callable[[LoopModel], RegionSearch]
    optimum: Optimum
    surface: ResidualSurface | None


def model_convergence(
    loop: SearchedLoop, space: SearchSpace, errors: Sequence[float], seed: int
) -> ConvergenceEstimate:
    """The state of convergence at the optimum of a loop.

    Args:
        loop: The loop.
        space: The tuned parameters.
        errors: Errors of the predictions of the log cost.
        seed: Of the draws.
    """
    optimum = loop.optimum
    draws = draw_optima(loop.fit, loop.search, optimum, seed)
    equal = equal_range(loop.search(loop.fit.model), optimum)
    low, high = np.fmin(draws.interval[0], equal[0]), np.fmax(draws.interval[1], equal[1])
    least, most = space.coordinate_bounds
    low, high = np.maximum(low, least), np.minimum(high, most)
    beyond = 0.0
    if loop.surface:
        beyond = ONE_SIDED_95 * loop.surface.deviation(optimum.coordinates)
    ends = (space.point(tuple(x.tolist())) for x in (low, high))
    return ConvergenceEstimate(
        noise=cost_noise(errors),
        remaining_improvement=-math.expm1(-float(np.quantile(draws.gains, 0.95)) - beyond),
        expected_improvement=-math.expm1(-float(np.mean(draws.gains))),
        intervals=tuple(zip(*ends, strict=True)),
        condition=_condition(loop, space),
    )


def _condition(loop: SearchedLoop, space: SearchSpace) -> str:
    """What the bound of the remaining improvement does not know."""
    within = []
    if space.at_bound(space.point(tuple(loop.optimum.coordinates.tolist()))):
        within.append("within the bounds of the search")
    left = f"{loop.fit.misfit:.1%}"
    if not loop.fit.is_white and left != "0.0%":
        within.append(f"by a model that leaves {left} of the step unexplained")
    return " and ".join(within)
