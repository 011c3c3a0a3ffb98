"""How well what is known before the first trial foretells a cost, and the numbers that do best."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from estune.core.quantities import FloatArray
from estune.tuners.gaussian_process import covariance, expected_before
from estune.tuners.loop_prior import CostPrior
from estune.tuners.safe_bayesian import clip_log_costs
from experiments.loop_prior.loops import NOISE, Loop

LOWER = np.tril_indices(4)
IMPOSSIBLE = 1e9
FIRST_TRIALS = 5  # the level is the median of so many


def likelihood(known: CostPrior, loops: Sequence[Loop]) -> float:
    """Mean logarithm of the likelihood of a trial's cost, as `newton` sees it."""
    return float(np.mean([_likelihood(known, loop) for loop in loops]))


def _likelihood(known: CostPrior, loop: Loop) -> float:
    costs = loop.costs + NOISE * np.random.default_rng(0).standard_normal(len(loop.costs))
    costs = clip_log_costs(costs - np.median(costs[:FIRST_TRIALS]))
    spread = covariance(known, loop.points, loop.points) + NOISE**2 * np.eye(len(costs))
    try:
        root = np.linalg.cholesky(spread)
    except np.linalg.LinAlgError:
        return -IMPOSSIBLE
    left = np.linalg.solve(root, costs - expected_before(known, loop.points))
    normal = 0.5 * math.log(2.0 * math.pi)
    return float(-0.5 * left @ left - np.sum(np.log(np.diag(root)))) / len(costs) - normal


def isotropic(loops: Sequence[Loop]) -> CostPrior:
    """The likeliest that knows no parameter from another."""

    def built(logarithms: FloatArray) -> CostPrior:
        slope, bowl, rest, size, bend = np.exp(logarithms)
        one = np.eye(4)
        return CostPrior(slope * one, bowl * one, rest * one, size, bend * one, one)

    begun = np.log([0.5, 0.35, 1.0 / 1.2, 0.8, 0.1])
    return built(minimize(lambda x: -likelihood(built(x), loops), begun, method="L-BFGS-B").x)


def fitted(loops: Sequence[Loop], begun: CostPrior, steps: int) -> CostPrior:
    """The likeliest of all, begun from another; takes minutes."""
    curvature = mean_curvature(loops)

    def built(numbers: FloatArray) -> CostPrior:
        parts = np.zeros((4, 4, 4))
        for part, own in zip(parts, numbers[:-1].reshape(4, -1), strict=True):
            part[LOWER] = own
        slope, bowl, rest, bend = parts
        return CostPrior(slope, bowl, rest, math.exp(numbers[-1]), bend @ bend.T, curvature)

    root = np.linalg.cholesky(begun.bend + 1e-3 * np.eye(4))  # rounded, it may bend down
    parts = [part[LOWER] for part in (begun.slope, begun.bowl, begun.rest, root)]
    first = np.concatenate([*parts, [math.log(begun.rest_size)]])
    options = {"maxiter": steps, "maxfun": 10**6}
    found = minimize(
        lambda x: -likelihood(built(x), loops), first, method="L-BFGS-B", options=options
    )
    return built(found.x)


def mean_curvature(loops: Sequence[Loop]) -> FloatArray:
    """Mean of the curvatures at the optima, its extreme twentieths drawn in, shape (4, 4)."""
    each = np.array([loop.curvature for loop in loops])
    low, high = np.percentile(each, [5.0, 95.0], axis=0)
    mean: FloatArray = np.clip(each, low, high).mean(axis=0)
    return mean
