"""Loops drawn at random: a plant, a cost, the optimum of the gains, and a search for it."""

import math
from dataclasses import dataclass
from typing import Any

import cma
import control
import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.trial.profiles import StepProfile
from estune.tuners.observation import Observation
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import SearchSpace
from plants.models.linear_plant import LinearPlant

SEARCHED = 24  # trials of a search that are kept, those of its wide phase
NOISE = 0.03
WIDE = 5.5  # the optimum is looked for within so many logarithms about what suits most loops
EVALUATIONS = 700  # of each of two searches for it
DIVERGED = 1e9
CENSORED = 3.0  # times the start's cost
OFF = 0.25  # share of the searches that begin anywhere about the optimum, not at weak gains
DIFFERENCE = 0.07  # of the logarithms, for the curvature


@dataclass(frozen=True)
class Loop:
    """A loop and a search on it, in logarithms of P, I, D and the setpoint filter's time constant.

    Attributes:
        points: Where the search's trials were, from its start on, shape (trials, 4).
        costs: Logarithms of what they cost, without noise, shape (trials,).
        curvature: Of the logarithm of the cost at the optimum, shape (4, 4).
    """

    points: FloatArray
    costs: FloatArray
    curvature: FloatArray


def draw(seed: int) -> Loop | None:
    """Draws a loop; None where the optimum has a gain at its bound."""
    random = np.random.default_rng([77, seed])
    plant, cost, period_s = _plant(random)

    def costs(x: FloatArray) -> FloatArray:
        found = plants.batch_costs(plant, np.exp(x), None, cost, workers=1)
        return np.log(np.where(np.isfinite(found), found, DIVERGED))

    usual = np.log([0.5, math.pi / (3.0 * period_s), 0.05 * period_s / math.pi, 0.05 * period_s])
    best, least = _optimum(costs, usual, random, seed)
    if np.max(np.abs(best - usual)) > WIDE - 0.3:
        return None
    start = _start(costs, best, least, random)
    if start is None:
        return None
    return Loop(*_search(costs, start, random), _curvature(costs, best))


def _plant(random: np.random.Generator) -> tuple[LinearPlant, StepCost, float]:
    """A plant with its limits and a cost, and the time its step response takes, s."""

    def between(low: float, high: float) -> float:
        return math.exp(random.uniform(math.log(low), math.log(high)))

    kind = random.choice(["second", "second", "second", "first", "lags", "second_lag"])
    rate = between(25.0, 150.0)  # samples a period
    delay = random.exponential(0.05) if random.random() < 0.6 else 0.0
    w = 2.0 * math.pi
    if kind == "second":
        system = control.tf([w * w], [1.0, 2.0 * between(0.03, 1.2) * w, w * w])
    elif kind == "first":
        delay = 0.3 * random.uniform(0.1, 1.0)
        system = control.tf([1.0], [0.3, 1.0])
    elif kind == "lags":
        order = int(random.integers(2, 6))
        system = control.tf([1.0], [0.5 / order, 1.0]) ** order
    else:
        resonance = control.tf([w * w], [1.0, 2.0 * between(0.05, 0.8) * w, w * w])
        system = resonance * control.tf([1.0], [between(0.01, 0.2), 1.0])
    period_s = between(0.05, 3.0)
    unit = control.ss(system)
    limit = 4.0 if random.random() < 0.5 else 1e6
    plant = plants.linear_plant(
        control.ss(unit.A / period_s, unit.B / period_s, unit.C, unit.D),
        dead_time_s=max(delay, 1.0 / rate) * period_s,
        sampling_Hz=rate / period_s,
        output_min_N=-limit,
        output_max_N=limit,
        derivative_filter_s=period_s / (w * between(4.0, 15.0)),
        profile=StepProfile(0.0, 1.0, 2.0 * period_s / rate, 6.0 * period_s),
    )
    cost = StepCost(
        period_s,
        time_unit=random.choice(["second", "settling_time"]),
        move_weight=between(0.1, 4.0),
        weight=random.choice(["printed", "printed", "rising"]),
    )
    return plant, cost, period_s


def _optimum(
    costs: Any, usual: FloatArray, random: np.random.Generator, seed: int
) -> tuple[FloatArray, float]:
    """Where the cost is least, and its logarithm there, by CMA-ES begun twice."""
    bounds = [list(usual - WIDE), list(usual + WIDE)]
    found = []
    for turn in (1, 2):
        options = {"bounds": bounds, "verbose": -9, "maxfevals": EVALUATIONS}
        begun = usual if turn == 1 else usual + random.normal(0.0, 0.5, 4)
        strategy = cma.CMAEvolutionStrategy(begun, 1.0, {**options, "seed": 2 * seed + turn})
        while not strategy.stop():
            asked = strategy.ask()
            strategy.tell(asked, list(costs(np.array(asked))))
        found.append((float(strategy.result.fbest), np.array(strategy.result.xbest)))
    least, best = min(found, key=lambda pair: pair[0])
    return best, least


def _start(
    costs: Any, best: FloatArray, least: float, random: np.random.Generator
) -> FloatArray | None:
    """Weak gains some three to eight times as costly as the optimum, or any two to three times."""
    off = random.random() < OFF
    for _ in range(20):
        away = random.normal(size=4)
        if not off:
            away = random.uniform([-3.0, -3.0, -3.0, 0.3], [-0.5, -1.0, -0.5, 3.0])
        ratio = random.uniform(1.8, 3.0) if off else random.uniform(3.0, 8.0)
        path = best + np.linspace(0.0, 3.0, 301)[:, np.newaxis] * away
        crossed = int(np.argmax(costs(path) - least >= math.log(ratio)))
        if crossed > 0:
            start: FloatArray = path[crossed]
            return start
    return None


def _search(
    costs: Any, start: FloatArray, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Where the default tuner looks in its first trials, from the start on, and what it costs."""
    space = SearchSpace.around(Gains(*np.exp(start).tolist()), 50.0)
    dearest = math.log(CENSORED) + float(costs(start[np.newaxis])[0])
    tuner = SafeBayesianTuner(space)
    state, points, found = tuner.start(), [], []
    for _ in range(SEARCHED):
        points.append(space.coordinates(tuner.ask(state)))
        found.append(min(float(costs(np.array(points[-1:]))[0]), dearest))
        noisy = found[-1] + math.log1p(NOISE * random.standard_normal())
        told = Observation(math.exp(min(noisy, dearest)), censored=noisy >= dearest)
        state = tuner.tell(state, told)
    return np.array(points) - start, np.array(found)


def _curvature(costs: Any, best: FloatArray) -> FloatArray:
    """By central differences, shape (4, 4)."""
    steps = DIFFERENCE * np.eye(4)
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
    points = [best + a * steps[i] + b * steps[j] for i, j in pairs for a, b in signs]
    found = costs(np.array(points)).reshape(-1, 4) @ (1.0, -1.0, -1.0, 1.0)
    curvature = np.zeros((4, 4))
    for (i, j), value in zip(pairs, found / (4.0 * DIFFERENCE**2), strict=True):
        curvature[i, j] = curvature[j, i] = value
    return curvature
