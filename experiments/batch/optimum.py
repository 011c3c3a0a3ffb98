"""The optimum of a process within limits, and the best setpoint filter of a rule."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.optimize import Bounds, minimize

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from experiments.batch.loop import ProcessLoop

MAX_SENSITIVITY, MAX_OVERSHOOT = 1.6, 0.05
"""The limits of a tuning by default."""

EXCESS = 1e-5
"""Excess over a limit that still counts as kept."""

REACH = 9.0
"""Greatest distance from a start in each logarithm."""

UNSTABLE = (30.0, 5.0, 5.0)
"""Logarithm of the cost, and excesses, of an unstable loop."""

FILTERS = 60
"""Time constants of the setpoint filter that are tried for a rule, none among them."""


def optimum(loop: ProcessLoop, cost: StepCost, starts: Sequence[Gains]) -> Gains:
    """The gains of least cost within the limits, by COBYQA from several starts.

    The search takes no slopes (Ragonneau and Zhang 2023). On 2 s and 1 s dead time, and on eight
    lags, it ends after 85 and 147 evaluations at what CMA-ES with a penalty finds in 1000, and is
    0.01 and 0.1 % below what that finds in 500.

    Args:
        loop: The loop.
        cost: The cost.
        starts: Gains to begin from.
    """

    @cache
    def judged(x: tuple[float, ...]) -> tuple[float, float, float]:
        value, Ms, overshoot = loop.judged(Gains(*np.exp(x).tolist()), cost)
        if not math.isfinite(value):
            return UNSTABLE
        return math.log(value), math.log(Ms / MAX_SENSITIVITY), overshoot - MAX_OVERSHOOT

    least, found = 0.1 * loop.h, list[FloatArray]()
    beyond = {"type": "ineq", "fun": lambda x: -np.array(judged(tuple(x))[1:])}
    for start in starts:
        P, I, D, tau = start.as_tuple()
        x = np.log([P, max(I, 1e-4 * P / loop.h / 600.0), max(D, least * P), max(tau, least)])
        end = minimize(
            lambda x: judged(tuple(x))[0],
            x,
            method="COBYQA",
            bounds=Bounds(x - REACH, x + REACH),
            constraints=[beyond],
            options={"initial_tr_radius": 0.4, "final_tr_radius": 1e-4},
        )
        found += [x, end.x]
    kept = [x for x in found if max(judged(tuple(x))[1:]) < EXCESS]
    return Gains(*np.exp(min(kept, key=lambda x: judged(tuple(x))[0])).tolist())


def with_best_filter(loop: ProcessLoop, cost: StepCost, gains: Gains) -> Gains:
    """The gains with the setpoint filter of least cost."""
    longest = loop.process.settling_time_s
    filters = [0.0, *np.geomspace(1e-3 * longest, 2.0 * longest, FILTERS).tolist()]
    options = [replace(gains, setpoint_filter_s=tau) for tau in filters]
    return min(options, key=lambda option: loop.judged(option, cost)[0])
