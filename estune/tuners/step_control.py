"""Step length of the tuners that step along a gradient, and the step scale after unsafe trials.

A constant adaptation gain is too large for some costs: the centre then circles about the optimum
at the step limit. Kesten (Annals of Mathematical Statistics 29, 1958) shortens the steps of a
stochastic approximation while they keep changing direction. Here every step u is multiplied by the
straightness of the path over about one dither period,

    straightness = max(least, |mean u| / mean |u|)

It is one where all steps agree and near zero where they cancel, and it rises again when the steps
find a direction. So the search still follows a plant that changes.

The step scale multiplies dither and steps (the paper's guard, eta < eta_max). It falls by 30 %
with an unsafe trial and recovers by 5 % with a safe one, up to one: eight safe trials make up for
an unsafe one. A tuner without a record of its trials also returns its centre to the best safe
point and resets its filters or its regression.
"""

import math

from estune.tuners.interface import TunerState
from estune.tuners.observation import Observation, usable_cost
from estune.tuners.search_space import Point

STRAIGHTNESS_MIN = 0.1
"""Shorter steps could not get going again."""

STEP_SCALE_MIN = 1.0 / 64.0
"""Below this the response to the dither would be lost in noise."""


def clip_norm(step: tuple[float, ...], limit: float) -> tuple[float, ...]:
    """The step, shortened to a length of at most the limit."""
    length = math.hypot(*step)
    return step if length <= limit else tuple([limit * (s / length) for s in step])


def kesten_step(
    step: tuple[float, ...], mean_step: tuple[float, ...], mean_length: float
) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """The step u times the straightness, and the means of u and |u| updated with u.

    Args:
        step: The step u.
        mean_step: Mean u so far; zero at first.
        mean_length: Mean |u| so far; zero at first.
    """
    share = 1.0 / (4 * (len(step) + 1))  # one over the dither period
    mean_step = tuple([d + share * (s - d) for d, s in zip(mean_step, step, strict=True)])
    mean_length += share * (math.hypot(*step) - mean_length)
    straightness = 1.0
    if mean_length > 0.0:
        straightness = max(STRAIGHTNESS_MIN, math.hypot(*mean_step) / mean_length)
    return tuple([straightness * s for s in step]), mean_step, mean_length


def shrink_after_unsafe(step_scale: float) -> float:
    """The step scale after an unsafe trial."""
    return max(0.7 * step_scale, STEP_SCALE_MIN)


def recover_after_safe(step_scale: float) -> float:
    """The step scale after a safe trial."""
    return min(1.05 * step_scale, 1.0)


def best_after(state: TunerState, point: Point, observation: Observation) -> tuple[Point, float]:
    """Point and cost of the best safe trial, once a safe trial at this point is known.

    Raises:
        InvalidInput: the cost is not finite although the observation is not censored.
    """
    cost = usable_cost(observation)
    if state.best_cost is None or cost < state.best_cost:
        return point, cost
    return state.best_point, state.best_cost
