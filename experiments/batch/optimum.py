"""The optimum of a process within limits, and the best setpoint filter of a rule."""

import math
from collections.abc import Sequence
from dataclasses import replace

import cma
import numpy as np

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from experiments.batch.loop import ProcessLoop

MAX_SENSITIVITY, MAX_OVERSHOOT = 1.6, 0.05
"""The limits of a tuning by default."""

PENALTY = 50.0
"""Logarithms of cost per unit beyond a limit."""

FILTERS = 60
"""Time constants of the setpoint filter that are tried for a rule, none among them."""


def optimum(loop: ProcessLoop, cost: StepCost, starts: Sequence[Gains], evaluations: int) -> Gains:
    """The gains of least cost within the limits, by CMA-ES from several starts.

    Args:
        loop: The loop.
        cost: The cost.
        starts: Gains to begin from.
        evaluations: Evaluations from each.
    """

    def rank(x: FloatArray) -> float:
        value, Ms, overshoot = loop.judged(Gains(*np.exp(x).tolist()), cost)
        if not math.isfinite(value):
            return 30.0
        beyond = max(min(math.log(Ms / MAX_SENSITIVITY), 5.0), 0.0)
        return math.log(value) + PENALTY * (beyond + max(overshoot - MAX_OVERSHOOT, 0.0))

    least = 0.1 * loop.h
    found = list[tuple[float, FloatArray]]()
    for number, start in enumerate(starts, 1):
        P, I, D, tau = start.as_tuple()
        x = np.log([P, max(I, 1e-4 * P / loop.h / 600.0), max(D, least * P), max(tau, least)])
        bounds = [list(x - 9.0), list(x + 9.0)]
        options = {"verbose": -9, "maxfevals": evaluations, "seed": number, "bounds": bounds}
        strategy = cma.CMAEvolutionStrategy(x, 0.4, options)
        while not strategy.stop():
            asked = strategy.ask()
            strategy.tell(asked, [rank(np.array(at)) for at in asked])
        found.append((float(strategy.result.fbest), np.array(strategy.result.xbest)))
    return Gains(*np.exp(min(found, key=lambda pair: pair[0])[1]).tolist())


def with_best_filter(loop: ProcessLoop, cost: StepCost, gains: Gains) -> Gains:
    """The gains with the setpoint filter of least cost."""
    longest = loop.process.settling_time_s
    filters = [0.0, *np.geomspace(1e-3 * longest, 2.0 * longest, FILTERS).tolist()]
    options = [replace(gains, setpoint_filter_s=tau) for tau in filters]
    return min(options, key=lambda option: loop.judged(option, cost)[0])
