"""The optimum of a problem, by a search strong enough to be trusted, remembered between runs."""

import json
import math
import os
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import differential_evolution, minimize

from estune.core.gains import Gains
from estune.tuners.search_space import Coordinates
from experiments.sample_efficiency.problems import Problem

OUT = Path(__file__).parents[1] / "out"
WARM_RATIO = 2.5
"""A warm start is this many times as costly as the optimum."""


class Optimum(NamedTuple):
    """Where a problem's cost is least.

    Attributes:
        coordinates: Logarithms of the gains.
        cost: The cost there, without noise.
        start_cost: That of the problem's start.
    """

    coordinates: Coordinates
    cost: float
    start_cost: float


@lru_cache
def optimum(problem: Problem) -> Optimum:
    """The optimum within the bounds, from the file of them where it was found before."""
    file = OUT / "sample_efficiency_optima.json"
    known: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    described = f"{problem.plant} {problem.cost} {problem.start} {problem.gauge_noise}"
    key = sha256(described.encode()).hexdigest()[:16]
    if key not in known:
        known[key] = search(problem)
        OUT.mkdir(exist_ok=True)
        written = file.with_suffix(f".{os.getpid()}")  # another process may be reading
        written.write_text(json.dumps(known))
        written.replace(file)
    coordinates, cost, start_cost = known[key]
    return Optimum(tuple(coordinates), cost, start_cost)


def search(problem: Problem) -> Optimum:
    """Differential evolution over the bounds, then Nelder-Mead until nothing is left to gain."""
    space = problem.space()
    low, high = np.array(space.coordinates_low), np.array(space.coordinates_high)
    smooth = problem if not problem.gauge_noise else problem.without_noise()

    def many(x: Any) -> Any:
        return np.log(np.minimum(smooth.costs(x.T), 1e9))

    def one(x: Any) -> float:
        return math.log(min(float(problem.costs(np.clip(x, low, high)[np.newaxis])[0]), 1e9))

    wide = differential_evolution(
        many,
        list(zip(low, high, strict=True)),
        popsize=20,
        maxiter=120,
        rng=1,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    found = wide.x
    for _ in range(3):  # begun anew, for a simplex may collapse early
        options = {"maxfev": 600, "xatol": 1e-6, "fatol": 1e-10}
        found = minimize(one, found, method="Nelder-Mead", options=options).x
    found = np.clip(found, low, high)
    start = np.array([space.coordinates(space.start)])
    return Optimum(tuple(found.tolist()), math.exp(one(found)), float(problem.costs(start)[0]))


def warm_start(problem: Problem, best: Optimum) -> Gains:
    """Gains 2.5 times as costly as the optimum, on the straight line to it from the start."""
    there = np.array(best.coordinates)
    away = np.array(problem.space().coordinates(problem.start.as_tuple())) - there
    shares = np.linspace(0.0, 1.0, 401)
    costs = problem.costs(there + shares[:, np.newaxis] * away)
    # The crossing nearest to the optimum.
    crossed = int(np.argmax(costs >= WARM_RATIO * best.cost))
    return Gains(*np.exp(there + shares[crossed] * away).tolist())
