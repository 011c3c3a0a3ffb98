"""Tuning rules, each with what its author takes from the process.

All rules know the process without noise: its ultimate gain and period, its step response, or its
time constants. To each dead time half a sample of the hold is added. The rules give gains of the
form that runs; where one is of a series form it is converted.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from experiments.batch.loop import ProcessLoop

STEP_SAMPLES = 2**14
"""Samples of an open-loop step response, whose end is its final value."""

LIGHTLY_DAMPED = 0.5
"""Damping below which a pair of poles has no two time constants."""

RELAY_SAMPLES, RELAY_PERIODS = 6_000, 4
"""Longest relay experiment, and the last periods of it that are averaged."""

PHASE_MARGIN = math.radians(60.0)


class FirstOrder(NamedTuple):
    """`gain e^(-dead s)/(T s + 1)`; of an integrator `gain e^(-dead s)/s`, and T is infinite."""

    gain: float
    T: float
    dead_s: float


def first_order(loop: ProcessLoop) -> FirstOrder:
    """The model by the steepest tangent and the 63 % time of the step response."""
    Phi, Gamma, C = loop.sampled
    n, h = C.size, loop.h
    M = np.eye(n + 1)
    M[:n, :n], M[:n, n] = Phi, Gamma
    rows = np.eye(1, n + 1, n)
    while len(rows) < STEP_SAMPLES:
        rows, M = np.concatenate([rows, rows @ M.T]), M @ M
    y, late_s = rows[:, :n] @ C, (loop.delay + 0.5) * h
    slopes = np.diff(y) / h
    if loop.process.integrators:
        return FirstOrder(slopes[-1], math.inf, (len(y) - 1) * h - y[-1] / slopes[-1] + late_s)
    at = int(np.argmax(slopes))
    tangent_s = (at + 0.5) * h - 0.5 * (y[at] + y[at + 1]) / slopes[at]
    after_s = float(np.argmax(y > 0.632 * y[-1])) * h
    dead_s = max(tangent_s, 0.0) + late_s
    return FirstOrder(float(y[-1]), max(after_s + late_s - dead_s, h), dead_s)


def amigo(loop: ProcessLoop) -> Gains | None:
    """AMIGO (Astrom and Hagglund 2004), PID."""
    gain, T, L = first_order(loop)
    if math.isinf(T):
        return Gains.from_standard(0.45 / (gain * L), 8.0 * L, 0.5 * L)
    K = (0.2 + 0.45 * T / L) / gain
    return Gains.from_standard(
        K, (0.4 * L + 0.8 * T) / (L + 0.1 * T) * L, 0.5 * L * T / (0.3 * L + T)
    )


def simc(loop: ProcessLoop) -> Gains | None:
    """SIMC (Skogestad 2003), PID of the process halved to two lags, tau_c the dead time."""
    process = loop.process
    lags = list(process.lags)
    if process.pair:
        T, damping = process.pair
        if damping < LIGHTLY_DAMPED:
            return None
        lags += [T, T]
    lags = sorted(lags, reverse=True)
    largest = [math.inf] * process.integrators + lags + [0.0, 0.0, 0.0]
    first, second, third = largest[:3]
    second += 0.5 * third if second != math.inf else 0.0
    dead_s = process.dead_time_s + 0.5 * loop.h + sum(process.zeros)
    dead_s += 0.5 * third + sum(largest[3:])
    reached = 2.0 * dead_s  # tau_c and the dead time
    speed = process.gain if math.isinf(first) else process.gain / first
    K, Ti, Td = 1.0 / (speed * reached), min(first, 4.0 * reached), second
    factor = 1.0 + Td / Ti
    return Gains.from_standard(K * factor, Ti * factor, Td / factor)


def lambda_rule(loop: ProcessLoop) -> Gains | None:
    """Lambda tuning, PI, with lambda the time constant; three dead times where it integrates."""
    gain, T, L = first_order(loop)
    if math.isinf(T):
        wanted = 3.0 * L
        return Gains.from_standard(
            (2.0 * wanted + L) / (gain * (wanted + L) ** 2), 2.0 * wanted + L, 0.0
        )
    return Gains.from_standard(T / (gain * (T + L)), T, 0.0)


def tyreus_luyben(loop: ProcessLoop) -> Gains | None:
    """Tyreus and Luyben (1992), PID, by the ultimate gain."""
    K, period_s = loop.process.ultimate
    return Gains.from_standard(K / 2.2, 2.2 * period_s, period_s / 6.3)


def ziegler_nichols(loop: ProcessLoop) -> Gains | None:
    """Ziegler and Nichols (1942), PID, by the ultimate gain."""
    K, period_s = loop.process.ultimate
    return Gains.from_standard(0.6 * K, 0.5 * period_s, 0.125 * period_s)


def relay(loop: ProcessLoop) -> Gains | None:
    """A relay experiment and 60 degrees of phase margin there, as automatic tuners do."""
    found = relay_experiment(loop)
    if found is None:
        return None
    K, period_s = found
    w, tangent = math.tau / period_s, math.tan(PHASE_MARGIN)
    Td = (tangent + math.sqrt(1.0 + tangent**2)) / (2.0 * w)  # with Ti = 4 Td
    return Gains.from_standard(K * math.cos(PHASE_MARGIN), 4.0 * Td, Td)


def relay_experiment(loop: ProcessLoop) -> tuple[float, float] | None:
    """Ultimate gain and period by a relay with hysteresis of three times the noise."""
    Phi, Gamma, C = loop.sampled
    rng = np.random.default_rng(0)
    late = np.zeros(loop.delay + 1)
    x, sign, band = np.zeros(C.size), 1.0, 3.0 * loop.noise
    y, switched = np.zeros(RELAY_SAMPLES), list[int]()
    for k in range(RELAY_SAMPLES):
        y[k] = C @ x
        measured = y[k] + loop.noise * rng.standard_normal()
        if sign * measured > band:
            sign = -sign
            switched.append(k)
        late = np.append(late[1:], sign)
        x = Phi @ x + Gamma * late[0]
    ends = switched[-(2 * RELAY_PERIODS + 1) :: 2]
    if len(ends) <= RELAY_PERIODS:
        return None
    period = (ends[-1] - ends[0]) / RELAY_PERIODS
    amplitude = 0.5 * float(np.ptp(y[ends[0] : ends[-1]]))
    return 4.0 / (math.pi * amplitude), period * loop.h


RULES: dict[str, Callable[[ProcessLoop], Gains | None]] = {
    "AMIGO": amigo,
    "SIMC": simc,
    "lambda": lambda_rule,
    "Tyreus-Luyben": tyreus_luyben,
    "Ziegler-Nichols": ziegler_nichols,
    "relay": relay,
}
