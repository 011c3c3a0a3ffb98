"""The algorithms compared: each calls `Trials` in a loop, in logarithms of the gains.

Algorithms that do better on the log cost are given it: Py-BOBYQA, Optuna, the Gaussian process and
SPSA. Settings other than the library's own were chosen on seeds below 100.
"""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.optimum import RobustnessLimits
from estune.tuners import Observation, RecordUsingTuner, Tuner, create_tuner
from estune.tuners.identified_loop import IdentifiedLoopTuner
from experiments.sample_efficiency.trials import Trials

Algorithm = Callable[[Trials], None]
"""Runs the trials; ends by itself or by `Spent`."""


def by_tuner(name: str, trials: Trials) -> None:
    """A registered tuner."""
    _tune(create_tuner(name, trials.space), trials, trials.job.budget)


def by_records(trials: Trials) -> None:
    """The default tuner, by the cost alone as all the others."""
    _tune(_model_based(trials), trials, trials.job.budget)


def after_records(algorithm: Algorithm, trials: Trials) -> None:
    """An algorithm that starts where the identified loop has its optimum after a few trials.

    So a peer has the same information, where its interface takes a starting point.
    """
    _tune(_model_based(trials), trials, RECORDED_TRIALS)
    trials.begin_at(trials.recommended)
    algorithm(trials)


def _model_based(trials: Trials) -> IdentifiedLoopTuner:
    free = RobustnessLimits(None, None, None)
    return IdentifiedLoopTuner(trials.space, trials.problem.trial, free)


def _tune(tuner: Tuner[Any], trials: Trials, count: int) -> None:
    state = tuner.start()
    records = isinstance(tuner, RecordUsingTuner)
    for _ in range(count):
        cost = trials(trials.space.coordinates(tuner.ask(state)))
        censored = cost >= trials.limit
        record = trials.record() if records and not censored else None
        state = tuner.tell(state, Observation(cost, censored, record=record))
        trials.settle_on(trials.space.coordinates(tuner.recommend(state)))


def tree_structured_parzen(trials: Trials) -> None:
    """Optuna's multivariate tree-structured Parzen estimator (Bergstra et al. 2011)."""
    import optuna  # noqa: PLC0415  an extra, and slow to import

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study, names = optuna.create_study(), trials.space.names
    sides = zip(*trials.space.coordinate_bounds, strict=True)
    ranges: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(low, high)
        for name, (low, high) in zip(names, sides, strict=True)
    }
    start = dict(zip(names, trials.start, strict=True))
    level = math.log(trials(trials.start))
    study.add_trial(optuna.trial.create_trial(params=start, distributions=ranges, value=level))
    for number in range(1, trials.job.budget):
        study.sampler = optuna.samplers.TPESampler(
            seed=trials.job.seed + 7919 * number, multivariate=True
        )
        asked = study.ask(ranges)
        cost = trials(tuple(asked.params[name] for name in names))
        study.tell(asked, math.inf if cost >= trials.limit else math.log(cost))


def quadratic_trust_region(trials: Trials) -> None:
    """Py-BOBYQA (Cartis et al. 2019) on the log cost, radius 0.5 to 0.1.

    An unsafe trial counts as twice as costly as the worst safe one: the model needs a number.
    """
    import pybobyqa  # noqa: PLC0415  an extra

    levels = [-math.inf]

    def level(x: FloatArray) -> float:
        cost = trials(x)
        if cost < trials.limit:
            levels.append(math.log(cost))
            return levels[-1]
        return math.log(2.0) + (max(levels) if len(levels) > 1 else 0.0)

    low, high = np.array(trials.space.coordinate_bounds)
    best = pybobyqa.solve(
        level,
        np.array(trials.start),
        bounds=(low, high),
        rhobeg=0.5,
        rhoend=0.1,
        maxfun=100_000,  # slower with a greater number, and not only by the trials made
        objfun_has_noise=True,
        do_logging=False,
    ).x
    while True:  # it has converged
        trials(best)


def gaussian_process(trials: Trials) -> None:
    """scikit-optimize's Gaussian process with its own acquisition, on the log cost."""
    from skopt import Optimizer  # noqa: PLC0415  an extra, and slow to import

    sides = list(zip(*trials.space.coordinate_bounds, strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its fits, and of repeated points
        optimizer = Optimizer(sides, "GP", n_initial_points=10, random_state=trials.job.seed)
        x = list(trials.start)
        for _ in range(trials.job.budget):
            optimizer.tell(x, math.log(trials(tuple(x))))
            x = optimizer.ask()


def evolution_strategy(trials: Trials) -> None:
    """CMA-ES (cma), initial step 0.5; it recommends its mean."""
    import cma  # noqa: PLC0415  an extra, and slow to import

    bounds = [*map(list, trials.space.coordinate_bounds)]
    options = {"bounds": bounds, "seed": trials.job.seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(list(trials.start), 0.5, options)
    trials.settle_on(trials.start)
    while True:
        points = strategy.ask()
        strategy.tell(points, [trials(x) for x in points])
        trials.settle_on(strategy.result.xfavorite)


def nelder_mead(trials: Trials) -> None:
    """Scipy's Nelder-Mead with a simplex 0.5 wide, restarted when it has collapsed."""
    from scipy.optimize import minimize  # noqa: PLC0415  slow to import

    bounds = list(zip(*trials.space.coordinate_bounds, strict=True))
    x = np.array(trials.start)
    while True:
        simplex = np.vstack([x, x + 0.5 * np.eye(len(x))])
        options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.0, "maxfev": 10**6}
        x = minimize(trials, x, method="Nelder-Mead", bounds=bounds, options=options).x


def simultaneous_perturbation(trials: Trials) -> None:
    """SPSA (Spall 1998) on the log cost, steps limited to 0.5, with the published exponents."""
    a, c, A = SPSA
    random = np.random.default_rng([trials.job.seed, 1])
    x = np.array(trials.start)
    trials.settle_on(x)
    k = 0
    while True:
        a_k, c_k = a / (k + 1 + A) ** 0.602, c / (k + 1) ** 0.101
        delta = random.choice([-1.0, 1.0], size=len(x))
        difference = math.log(trials(x + c_k * delta)) - math.log(trials(x - c_k * delta))
        step = a_k * difference / (2.0 * c_k) * delta
        x = x - step * min(1.0, 0.5 / max(float(np.linalg.norm(step)), 1e-12))
        x = np.array(trials.space.clipped(tuple(x.tolist())))
        trials.settle_on(x)
        k += 1


SPSA = (8.0, 0.3, 5.0)
"""a, c and A of Spall's gains a_k = a/(k + 1 + A)^0.602 and c_k = c/(k + 1)^0.101."""

RECORDED_TRIALS = 4
"""Trials of the default tuner before a peer goes on: those after which it stops by itself."""

OURS = ("model_based", "safe_bayesian", "phase_compensated", "least_squares_gradient")
PUBLISHED = ("otis", "killingsworth")

_PEERS: dict[str, Algorithm] = {
    "Optuna TPE": tree_structured_parzen,
    "Py-BOBYQA": quadratic_trust_region,
    "CMA-ES": evolution_strategy,
    "Nelder-Mead": nelder_mead,
}
FROM_THE_MODEL: dict[str, Algorithm] = {
    f"{name} from the model": partial(after_records, peer) for name, peer in _PEERS.items()
}
"""Peers that take a start, from that of the identified loop."""

ALGORITHMS: dict[str, Algorithm] = {
    "model_based": by_records,
    **{name: partial(by_tuner, name) for name in (*OURS[1:], *PUBLISHED)},
    **_PEERS,
    "skopt GP": gaussian_process,
    "SPSA": simultaneous_perturbation,
    **FROM_THE_MODEL,
}
"""The algorithms by their names in the tables."""
