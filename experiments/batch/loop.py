"""The sampled loop of a process, simulated and judged without estune's own simulation or margins.

The process is exact under zero-order hold. With the controller it is one difference equation

    z_{k+1} = M z_k + b_r r_k + b_n n_k + b_l l_k

of the states of the process, the efforts under way in the dead time, the integral and the two
filters; r is the setpoint, n the noise of the measurement and l a load added to the effort. A
step response is the powers of M, by repeated doubling. Ms is the peak of the frequency response,
stability the largest eigenvalue of M.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import ComplexArray, FloatArray
from estune.core.response import LoadStep, StepShape
from experiments.batch.processes import Process

FILTER_SAMPLES = 2.0
"""Time constant of the filter on the derivative, in samples, for all gains."""

TRIAL_SETTLING_TIMES, BEFORE = 5.0, 0.1
"""Length of a trial after its step in settling times, and before it as a share of that."""

VANISHED = 0.05
"""Share of the peak within which a load has vanished."""

LONG = 2**15
"""Samples after which a load counts as staying for ever: 270 settling times."""

LOAD = -0.5
"""Load of a trial whose cost weighs rejection, after the step and as long: estune's own choice."""

DRAWS = 4
"""Draws of the noise in a mean cost."""


class LoopFigures(NamedTuple):
    """What is true of a loop with some gains.

    Attributes:
        cost: Mean cost over draws of the noise; infinite where the loop is unstable.
        Ms: Peak of the sensitivity; infinite where the loop is unstable.
        overshoot: Share of the step, without noise.
        load_IAE: Integral of |error| after a unit step of the load, s; infinite where it stays.
        load_peak: Largest error after it, per unit of load.
        load_time_s: Time after which the error stays below `VANISHED` of its peak.
    """

    cost: float
    Ms: float
    overshoot: float
    load_IAE: float
    load_peak: float
    load_time_s: float


UNSTABLE = LoopFigures(math.inf, math.inf, math.inf, math.inf, math.inf, math.inf)


class Matrices(NamedTuple):
    """The loop's equation; the effort is `u_k = u_z z_k + u_r r_k + u_n n_k`, the output C x."""

    M: FloatArray
    setpoint: FloatArray
    noise: FloatArray
    load: FloatArray
    effort: FloatArray
    effort_of_setpoint: float
    effort_of_noise: float
    output: FloatArray


@dataclass(frozen=True)
class ProcessLoop:
    """A process with its controller at one sampling rate.

    Attributes:
        process: The process.
        noise: Standard deviation of the measurement's noise, as a share of the step of one.
    """

    process: Process
    noise: float = 0.0

    @property
    def h(self) -> float:
        """Sample interval, s."""
        return self.process.sample_s

    @property
    def delay(self) -> int:
        """Dead time in samples."""
        return round(self.process.dead_time_s / self.h)

    @property
    def after(self) -> int:
        """Samples of a trial after its step."""
        return round(TRIAL_SETTLING_TIMES * self.process.settling_time_s / self.h)

    @property
    def before(self) -> int:
        """Samples of a trial before its step."""
        return round(BEFORE * self.after)

    @cached_property
    def sampled(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Phi, Gamma and C under zero-order hold."""
        A, B, C = self.process.state_space
        n = B.size
        both = np.zeros((n + 1, n + 1))
        both[:n, :n], both[:n, n] = A * self.h, B * self.h
        both = expm(both)
        return both[:n, :n], both[:n, n], C

    @cached_property
    def _frequencies(self) -> tuple[FloatArray, ComplexArray]:
        """Angles, and the response of the process there."""
        theta = np.concatenate([np.geomspace(1e-5, 0.6, 900), np.linspace(0.6, math.pi, 400)])
        if self.process.pair:
            own = self.h / self.process.pair[0]
            theta = np.union1d(theta, own * np.linspace(0.7, 1.3, 301))
        Phi, Gamma, C = self.sampled
        z = np.exp(1j * theta)
        resolvent = z[:, None, None] * np.eye(C.size) - Phi
        states = np.linalg.solve(resolvent, np.tile(Gamma[:, None], (theta.size, 1, 1)))
        return theta, np.asarray((states[:, :, 0] @ C) * z ** -float(self.delay), complex)

    def response(self, gains: Gains) -> ComplexArray:
        """Frequency response of the open loop."""
        theta, G = self._frequencies
        z, h = np.exp(1j * theta), self.h
        span = (FILTER_SAMPLES + 1.0) * h
        derivative = (z - 1.0) / (span * z - FILTER_SAMPLES * h)
        controller = gains.P + gains.I * h / (z - 1.0) + gains.D * derivative
        return np.asarray(G * controller)

    def matrices(self, gains: Gains) -> Matrices:
        """The equation of the closed loop."""
        Phi, Gamma, C = self.sampled
        n, d, h = C.size, self.delay, self.h
        P, I, D, tau = gains.as_tuple()
        pole = math.exp(-h / tau) if tau > 0.0 else 0.0
        span = (FILTER_SAMPLES + 1.0) * h
        size = n + d + 3
        integral, filtered, slow = n + d, n + d + 1, n + d + 2
        measured = np.zeros(size)
        measured[:n] = C
        error = -measured
        error[filtered] += pole  # r_f = pole r_f- + (1 - pole) r
        slope = measured / span
        slope[slow] -= 1.0 / span
        effort = P * error - D * slope
        effort[integral] += 1.0
        of_setpoint, of_noise = P * (1.0 - pole), -P - D / span
        M, b_r, b_n, b_l = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
        M[:n, :n] = Phi
        if d:
            M[:n, n + d - 1] = Gamma
            M[n + 1 : n + d, n : n + d - 1] = np.eye(d - 1)
            M[n], b_r[n], b_n[n], b_l[n] = effort, of_setpoint, of_noise, 1.0
        else:
            M[:n] += np.outer(Gamma, effort)
            b_r[:n], b_n[:n], b_l[:n] = of_setpoint * Gamma, of_noise * Gamma, Gamma
        M[integral] = I * h * error
        M[integral, integral] += 1.0
        b_r[integral], b_n[integral] = I * h * (1.0 - pole), -I * h
        M[filtered, filtered], b_r[filtered] = pole, 1.0 - pole
        M[slow] = h * slope
        M[slow, slow] += 1.0
        b_n[slow] = h / span
        return Matrices(M, b_r, b_n, b_l, effort, of_setpoint, of_noise, measured)

    def at(self, gains: Gains, cost: StepCost) -> LoopFigures:
        """What is true of the loop with these gains."""
        judged = self.judged(gains, cost)
        if not math.isfinite(judged[0]):
            return UNSTABLE
        return LoopFigures(*judged, *self._rejection(self.matrices(gains)))

    def judged(self, gains: Gains, cost: StepCost) -> tuple[float, float, float]:
        """Cost, Ms and overshoot alone: what a search of the optimum needs."""
        m = self.matrices(gains)
        if not np.isfinite(m.M).all() or np.abs(np.linalg.eigvals(m.M)).max() >= 1.0:
            return UNSTABLE[:3]
        Ms = float(np.max(1.0 / np.abs(1.0 + self.response(gains))))
        states = driven(m.M, m.setpoint, self.after)
        overshoot = max(float((states @ m.output).max()) - 1.0, 0.0)
        return self._cost(m, states, cost), Ms, overshoot

    def _cost(self, m: Matrices, states: FloatArray, cost: StepCost) -> float:
        """Mean cost of a trial over draws of the noise."""
        count, before = self.after, self.before
        setpoint = np.concatenate([np.zeros(before), np.ones(count)])
        output, effort = states @ m.output, states @ m.effort + m.effort_of_setpoint
        shape = StepShape(before, 1.0)
        output, effort = (np.concatenate([np.zeros(before), part]) for part in (output, effort))
        if cost.rejection:
            after_load = LOAD * driven(m.M, m.load, count)
            later = driven(m.M, m.setpoint, 2 * count)[count:]
            output = np.concatenate([output, (later + after_load) @ m.output])
            effort = np.concatenate(
                [effort, (later + after_load) @ m.effort + m.effort_of_setpoint]
            )
            setpoint = np.concatenate([setpoint, np.ones(count)])
            shape = shape._replace(load=LoadStep(before + count, LOAD))
        if self.noise:
            noise = self.noise * noise_rows(setpoint.size)
            filtered = impulse(m.M, m.noise, setpoint.size)
            output = output + noise + convolved(noise, filtered @ m.output)
            effort = effort + m.effort_of_noise * noise + convolved(noise, filtered @ m.effort)
        return float(np.mean(cost.evaluate(1.0 / self.h, shape, setpoint, output, effort)))

    def _rejection(self, m: Matrices) -> tuple[float, float, float]:
        """IAE, peak and time of the error after a unit step of the load."""
        error = np.abs(driven(m.M, m.load, LONG) @ m.output)
        peak = float(error.max())
        out = np.flatnonzero(error > VANISHED * peak)
        last = int(out[-1]) + 1
        if last > LONG // 2:
            return math.inf, peak, math.inf
        return float(error.sum() * self.h), peak, last * self.h


def driven(M: FloatArray, b: FloatArray, count: int) -> FloatArray:
    """States after a unit step of an input from zero, shape (count, states), the first zero."""
    n = b.size
    A = np.eye(n + 1)
    A[:n, :n], A[:n, n] = M, b
    rows = np.eye(1, n + 1, n)
    while len(rows) < count:
        rows = np.concatenate([rows, rows @ A.T])
        A = A @ A
    return np.asarray(rows[:count, :n])


def impulse(M: FloatArray, b: FloatArray, count: int) -> FloatArray:
    """States after a unit impulse of an input, shape (count, states), the first zero."""
    rows, A = b[None], M
    while len(rows) < count - 1:
        rows = np.concatenate([rows, rows @ A.T])
        A = A @ A
    return np.concatenate([np.zeros((1, b.size)), rows[: count - 1]])


def convolved(rows: FloatArray, answer: FloatArray) -> FloatArray:
    """Each row filtered by an impulse response, shape of the rows."""
    count = rows.shape[-1]
    size = 2 * count
    spectrum = np.fft.rfft(rows, size) * np.fft.rfft(answer, size)
    return np.asarray(np.fft.irfft(spectrum, size)[..., :count])


def noise_rows(count: int) -> FloatArray:
    """White noise of the true costs, which no trial has, shape (DRAWS, count)."""
    return np.random.default_rng(777_000).standard_normal((DRAWS, count))
