"""The optimum of a problem by global and local search, cached between runs."""

import json
import math
import os
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import differential_evolution, minimize

from estune.tuners.search_space import Coordinates
from experiments.sample_efficiency.problems import Problem

OUT = Path("out")


class TrueOptimum(NamedTuple):
    """The optimum of a problem.

    Attributes:
        coordinates: Logarithms of the gains.
        cost: Cost at the optimum, without noise.
    """

    coordinates: Coordinates
    cost: float


@lru_cache
def optimum(problem: Problem) -> TrueOptimum:
    """The optimum within the bounds, from the cache file if it is there."""
    file = OUT / "sample_efficiency_optima.json"
    cached: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    described = f"{problem.plant} {problem.cost} {problem.start}"
    key = sha256(described.encode()).hexdigest()[:16]
    if key not in cached:
        cached[key] = search(problem)
        OUT.mkdir(exist_ok=True)
        written = file.with_suffix(f".{os.getpid()}")  # another process may be reading
        written.write_text(json.dumps(cached))
        written.replace(file)
    coordinates, cost = cached[key]
    return TrueOptimum(tuple(coordinates), cost)


def search(problem: Problem) -> TrueOptimum:
    """Differential evolution over the bounds, then Nelder-Mead until it converges."""
    space = problem.space
    low, high = np.array(space.coordinate_bounds)

    def many(x: Any) -> Any:
        return np.log(np.minimum(problem.costs(x.T), 1e9))

    def one(x: Any) -> float:
        return math.log(min(float(problem.costs(np.clip(x, low, high)[np.newaxis])[0]), 1e9))

    x = differential_evolution(
        many,
        list(zip(low, high, strict=True)),
        popsize=20,
        maxiter=120,
        rng=1,
        vectorized=True,
        updating="deferred",
        polish=False,
    ).x
    for _ in range(3):  # restarted, because a simplex may collapse early
        options = {"maxfev": 600, "xatol": 1e-6, "fatol": 1e-10}
        x = minimize(one, x, method="Nelder-Mead", options=options).x
    x = np.clip(x, low, high)
    return TrueOptimum(tuple(x.tolist()), math.exp(one(x)))
