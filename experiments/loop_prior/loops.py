"""Random loops: a plant, a cost, the optimal gains, and a search for them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cma
import control
import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.trial.profiles import StepProfile
from estune.tuners import Observation, SearchSpace
from estune.tuners.safe_bayesian import SafeBayesianTuner
from plants.models.linear_plant import LinearPlant

SEARCH_TRIALS = 24  # those with the Gaussian process
NOISE = 0.03
RANGE = 5.5  # of the search for the optimum, in logarithms about usual gains
EVALUATIONS = 700  # of each of two searches for the optimum
DIVERGED = 1e9
CENSORED = 3.0  # times the start's cost
ANYWHERE_SHARE = 0.25  # of the searches that start anywhere about the optimum, not at weak gains
DIFFERENCE = 0.07  # step in logarithms, for the curvature


@dataclass(frozen=True)
class RandomLoop:
    """A loop and a search on it, in logarithms of P, I, D and the setpoint filter's time constant.

    Attributes:
        points: Coordinates of the trials relative to the start, shape (trials, 4).
        costs: Their log costs without noise, shape (trials,).
        curvature: Of the logarithm of the cost at the optimum, shape (4, 4).
    """

    points: FloatArray
    costs: FloatArray
    curvature: FloatArray


class DrawnLoop(NamedTuple):
    """A plant and a cost, the optimum and a start of a search, both as logarithms of gains."""

    plant: LinearPlant
    cost: StepCost
    log_costs: Callable[[FloatArray], FloatArray]  # without noise, of gains by rows
    best: FloatArray
    start: FloatArray
    random: np.random.Generator  # by which it was drawn


def draw_loop(seed: int) -> DrawnLoop | None:
    """Draws a loop; None where the optimum has a gain at its bound."""
    random = np.random.default_rng([77, seed])
    plant, cost, period_s = random_plant(random)

    def costs(x: FloatArray) -> FloatArray:
        values = plants.batch_costs(plant, np.exp(x), None, cost, workers=1)
        return np.log(np.where(np.isfinite(values), values, DIVERGED))

    usual = np.log([0.5, math.pi / (3.0 * period_s), 0.05 * period_s / math.pi, 0.05 * period_s])
    best, least = optimum(costs, usual, random, seed)
    if np.max(np.abs(best - usual)) > RANGE - 0.3:
        return None
    start = random_start(costs, best, least, random)
    return None if start is None else DrawnLoop(plant, cost, costs, best, start, random)


def draw(seed: int) -> RandomLoop | None:
    """A loop drawn at random with a search on it; None as of `draw_loop`."""
    d = draw_loop(seed)
    if d is None:
        return None
    return RandomLoop(*_search(d.log_costs, d.start, d.random), _curvature(d.log_costs, d.best))


def random_plant(random: np.random.Generator) -> tuple[LinearPlant, StepCost, float]:
    """A plant with its limits, a cost, and the time of its step response, s."""

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


def optimum(
    costs: Any, usual: FloatArray, random: np.random.Generator, seed: int
) -> tuple[FloatArray, float]:
    """The optimum and its log cost, by CMA-ES from two starts."""
    bounds = [list(usual - RANGE), list(usual + RANGE)]
    results = []
    for attempt in (1, 2):
        options = {"bounds": bounds, "verbose": -9, "maxfevals": EVALUATIONS}
        initial = usual if attempt == 1 else usual + random.normal(0.0, 0.5, 4)
        strategy = cma.CMAEvolutionStrategy(initial, 1.0, {**options, "seed": 2 * seed + attempt})
        while not strategy.stop():
            asked = strategy.ask()
            strategy.tell(asked, list(costs(np.array(asked))))
        results.append((float(strategy.result.fbest), np.array(strategy.result.xbest)))
    least, best = min(results, key=lambda pair: pair[0])
    return best, least


def random_start(
    costs: Any, best: FloatArray, least: float, random: np.random.Generator
) -> FloatArray | None:
    """Weak gains at three to eight times the optimal cost, or any gains at two to three times."""
    anywhere = random.random() < ANYWHERE_SHARE
    for _ in range(20):
        away = random.normal(size=4)
        if not anywhere:
            away = random.uniform([-3.0, -3.0, -3.0, 0.3], [-0.5, -1.0, -0.5, 3.0])
        ratio = random.uniform(1.8, 3.0) if anywhere else random.uniform(3.0, 8.0)
        path = best + np.linspace(0.0, 3.0, 301)[:, np.newaxis] * away
        crossed = int(np.argmax(costs(path) - least >= math.log(ratio)))
        if crossed > 0:
            start: FloatArray = path[crossed]
            return start
    return None


def _search(
    costs: Any, start: FloatArray, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Coordinates relative to the start, and log costs, of the first trials of a search."""
    space = SearchSpace.around(Gains(*np.exp(start).tolist()), 50.0)
    most = math.log(CENSORED) + float(costs(start[np.newaxis])[0])
    tuner = SafeBayesianTuner(space)
    state, points, log_costs = tuner.start(), [], []
    for _ in range(SEARCH_TRIALS):
        points.append(space.coordinates(tuner.ask(state)))
        log_costs.append(min(float(costs(np.array(points[-1:]))[0]), most))
        noisy = log_costs[-1] + math.log1p(NOISE * random.standard_normal())
        observation = Observation(math.exp(min(noisy, most)), censored=noisy >= most)
        state = tuner.tell(state, observation)
    return np.array(points) - start, np.array(log_costs)


def _curvature(costs: Any, best: FloatArray) -> FloatArray:
    """Curvature of the log cost by central differences, shape (4, 4)."""
    steps = DIFFERENCE * np.eye(4)
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
    points = [best + a * steps[i] + b * steps[j] for i, j in pairs for a, b in signs]
    differences = costs(np.array(points)).reshape(-1, 4) @ (1.0, -1.0, -1.0, 1.0)
    curvature = np.zeros((4, 4))
    for (i, j), value in zip(pairs, differences / (4.0 * DIFFERENCE**2), strict=True):
        curvature[i, j] = curvature[j, i] = value
    return curvature
