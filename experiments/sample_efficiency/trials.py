"""Trials on a problem for one algorithm: noise, budget, recommended gains."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.records import LoopRecord
from estune.tuners.search_space import Coordinates
from experiments.sample_efficiency.problems import PROBLEMS

NOISE = 0.03
"""Relative standard deviation of a trial's cost."""

ETA_MAX_RATIO = 3.0
"""A trial this many times as costly as the start is aborted, and its cost counts as this."""

UNSAFE_RATIO = 1.5
"""A trial with a noise-free cost of more than this times the start's is unsafe."""


class Job(NamedTuple):
    """A search: names of problem and algorithm, seed of noise and algorithm, number of trials."""

    problem: str
    algorithm: str
    seed: int
    budget: int


class Spent(Exception):
    """The budget of trials is spent."""


class Trials:
    """Costs of trials in logarithms of the gains, one after the other.

    An algorithm calls it with coordinates and gets a cost, until it raises `Spent`. It recommends
    the best noisy trial, unless it calls `settle_on`.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        self.problem = PROBLEMS[job.problem]
        self.space = self.problem.space
        self.start: Coordinates = self.space.coordinates(self.space.start)
        self.costs: list[float] = []  # without noise
        random = np.random.Generator(np.random.Philox(key=job.seed))
        self._noise = 1.0 + NOISE * random.standard_normal(job.budget)
        self._start_cost = self._quiet(self.start)
        self.limit = ETA_MAX_RATIO * self._start_cost
        self._last = self.start
        self._settled: list[Coordinates] = []
        self._centre: Coordinates | None = None
        self._best = (math.inf, self.start)

    def __call__(self, coordinates: Coordinates | FloatArray) -> float:
        """The noisy cost of the next trial, at most `limit`; raises Spent after the last one."""
        number = len(self.costs)
        if number:
            self._settled.append(self.recommended)
        if number >= self.job.budget:
            raise Spent
        self._last = self.space.clipped(tuple(map(float, coordinates)))
        self.costs.append(self._quiet(self._last))
        noisy = min(self.costs[-1] * float(self._noise[number]), self.limit)
        self._best = min(self._best, (noisy, self._last))
        return noisy

    def record(self) -> LoopRecord:
        """The signals of the last trial."""
        return self.problem.record(self._last)

    def begin_at(self, coordinates: Coordinates | FloatArray) -> None:
        """Sets the point from which another algorithm goes on, and forgets the recommended one."""
        self._centre = None
        self.start = self.space.clipped(tuple(map(float, coordinates)))
        self.space = replace(self.space, start=self.space.point(self.start))

    @property
    def recommended(self) -> Coordinates:
        """The point recommended now."""
        return self._centre or self._best[1]

    def settle_on(self, coordinates: Coordinates | FloatArray) -> None:
        """Sets the point that the algorithm recommends after the last trial."""
        self._centre = self.space.clipped(tuple(map(float, coordinates)))

    @property
    def unsafe(self) -> int:
        """Number of unsafe trials."""
        return sum(cost > UNSAFE_RATIO * self._start_cost for cost in self.costs)

    def settled_costs(self) -> FloatArray:
        """Noise-free cost of the recommended point after each trial, shape (budget,)."""
        while len(self._settled) < len(self.costs):
            self._settled.append(self.recommended)
        points = np.array(self._settled)
        distinct, inverse = np.unique(points, axis=0, return_inverse=True)
        return self.problem.costs(distinct)[inverse]

    def _quiet(self, point: Coordinates) -> float:
        return float(self.problem.costs(np.array([point]))[0])
