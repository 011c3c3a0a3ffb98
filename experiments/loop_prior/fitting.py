"""Likelihood of costs under a prior, and the priors that maximise it."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize

from estune.core.quantities import FloatArray
from estune.tuners.gaussian_process import CostPrior, prior_covariance, prior_mean
from estune.tuners.safe_bayesian_state import clip_log_costs
from experiments.loop_prior.loops import NOISE, RandomLoop

LOWER = np.tril_indices(4)
IMPOSSIBLE = 1e9
FIRST_TRIALS = 5  # the reference cost is the median of so many


def likelihood(prior: CostPrior, loops: Sequence[RandomLoop]) -> float:
    """Mean log likelihood of a trial's cost, as the safe Bayesian tuner sees it."""
    return float(np.mean([_likelihood(prior, loop) for loop in loops]))


def _likelihood(prior: CostPrior, loop: RandomLoop) -> float:
    costs = loop.costs + NOISE * np.random.default_rng(0).standard_normal(len(loop.costs))
    costs = clip_log_costs(costs - np.median(costs[:FIRST_TRIALS]))
    covariance = prior_covariance(prior, loop.points, loop.points)
    try:
        root = np.linalg.cholesky(covariance + NOISE**2 * np.eye(len(costs)))
    except np.linalg.LinAlgError:
        return -IMPOSSIBLE
    whitened = np.linalg.solve(root, costs - prior_mean(prior, loop.points))
    normal = 0.5 * math.log(2.0 * math.pi)
    return float(-0.5 * whitened @ whitened - np.sum(np.log(np.diag(root)))) / len(costs) - normal


def isotropic(loops: Sequence[RandomLoop]) -> CostPrior:
    """The likeliest prior that treats all parameters alike."""

    def prior(logarithms: FloatArray) -> CostPrior:
        slope, quadratic, inverse_length, remainder_sd, mean_rise = np.exp(logarithms)
        one = np.eye(4)
        return CostPrior(
            slope * one, quadratic * one, inverse_length * one, remainder_sd, mean_rise * one, one
        )

    return _likeliest(prior, np.log([0.5, 0.35, 1.0 / 1.2, 0.8, 0.1]), loops)


def fitted(loops: Sequence[RandomLoop], initial: CostPrior, steps: int) -> CostPrior:
    """The likeliest prior, from an initial one; takes minutes."""
    curvature = mean_curvature(loops)

    def prior(numbers: FloatArray) -> CostPrior:
        parts = np.zeros((4, 4, 4))
        for part, own in zip(parts, numbers[:-1].reshape(4, -1), strict=True):
            part[LOWER] = own
        slope, quadratic, inverse_length, root = parts
        remainder_sd = math.exp(numbers[-1])
        return CostPrior(slope, quadratic, inverse_length, remainder_sd, root @ root.T, curvature)

    # Rounded, the mean rise may have a negative curvature.
    root = np.linalg.cholesky(initial.mean_rise + 1e-3 * np.eye(4))
    parts = (initial.slope, initial.quadratic, initial.inverse_length, root)
    numbers = np.concatenate([*[p[LOWER] for p in parts], [math.log(initial.remainder_sd)]])
    return _likeliest(prior, numbers, loops, {"maxiter": steps, "maxfun": 10**6})


def _likeliest(
    prior: Callable[[FloatArray], CostPrior],
    initial: FloatArray,
    loops: Sequence[RandomLoop],
    options: dict[str, int] | None = None,
) -> CostPrior:
    solution = minimize(
        lambda x: -likelihood(prior(x), loops), initial, method="L-BFGS-B", options=options
    )
    return prior(solution.x)


def mean_curvature(loops: Sequence[RandomLoop]) -> FloatArray:
    """Winsorised mean of the curvatures at the optima, 5 % to either side, shape (4, 4)."""
    each = np.array([loop.curvature for loop in loops])
    low, high = np.percentile(each, [5.0, 95.0], axis=0)
    mean: FloatArray = np.clip(each, low, high).mean(axis=0)
    return mean
