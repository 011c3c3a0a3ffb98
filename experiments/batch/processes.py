"""The processes: the batch of Astrom and Hagglund, and plants that are unstable in open loop.

The batch is of *Advanced PID Control* (2006), section 7.2, with an oscillatory process beside it;
time is in seconds, and the gain is one where there is one. The last family is not of the batch:
no rule of `rules` is made for it.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import ComplexArray, FloatArray

SAMPLES = 60
"""Samples in the ultimate period. A lag of a quarter of it, the usual dead time, has 15."""

UNSTABLE = "unstable in open loop"


@dataclass(frozen=True)
class Process:
    """A process `gain prod(1 - z s) e^(-dead s) / (s^integrators prod(T s + 1) ...)`.

    Attributes:
        name: Short name.
        family: Its family in the batch.
        lags: Time constants T, s; a negative one is of an unstable pole.
        pair: Time constant T and damping d of a factor (T s)^2 + 2 d T s + 1; empty without one.
        integrators: Number of integrators.
        zeros: Time constants z of zeros in the right half plane, s.
        dead_time_s: Dead time.
        gain: Gain without the integrators.
        start: Initial gains; None where half a rule gives them.
        settling_s: Desired settling time; None for twice the ultimate period.
    """

    name: str
    family: str
    lags: tuple[float, ...] = ()
    pair: tuple[float, float] | tuple[()] = ()
    integrators: int = 0
    zeros: tuple[float, ...] = ()
    dead_time_s: float = 0.0
    gain: float = 1.0
    start: Gains | None = field(default=None, repr=False)
    settling_s: float | None = None

    def response(self, rad_s: FloatArray) -> ComplexArray:
        """G(i w), shape of the frequencies."""
        s = 1j * rad_s
        G = self.gain * np.exp(-self.dead_time_s * s) / s**self.integrators
        for z in self.zeros:
            G = G * (1.0 - z * s)
        for T in self.lags:
            G = G / (T * s + 1.0)
        if self.pair:
            T, d = self.pair
            G = G / ((T * s) ** 2 + 2.0 * d * T * s + 1.0)
        return np.asarray(G)

    @cached_property
    def ultimate(self) -> tuple[float, float]:
        """Ultimate gain and period of the process in continuous time; NaN where there are none."""
        rad_s = np.geomspace(1e-4, 1e4, 200_001)
        G = self.response(rad_s)
        phase = np.unwrap(np.angle(G))
        phase -= 2.0 * math.pi * round((phase[0] + 0.5 * math.pi * self.integrators) / math.tau)
        below = np.flatnonzero(phase < -math.pi)
        if not below.size or below[0] == 0:
            return math.nan, math.nan
        at = int(below[0])
        return 1.0 / float(abs(G[at])), math.tau / float(rad_s[at])

    @property
    def settling_time_s(self) -> float:
        """Desired settling time of the cost."""
        return self.settling_s or 2.0 * self.ultimate[1]

    @property
    def sample_s(self) -> float:
        """Sample interval: a whole number of them is the dead time."""
        wanted = self.settling_time_s / (2.0 * SAMPLES)
        whole = round(self.dead_time_s / wanted)
        return self.dead_time_s / whole if whole else wanted

    @cached_property
    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and C without the dead time, shapes (n, n), (n,) and (n,)."""
        below: Any = np.ones(1)
        above: Any = np.array([self.gain])
        for T in self.lags:
            below = np.polymul(below, [T, 1.0])
        if self.pair:
            T, d = self.pair
            below = np.polymul(below, [T * T, 2.0 * d * T, 1.0])
        for z in self.zeros:
            above = np.polymul(above, [-z, 1.0])
        below = np.polymul(below, np.eye(1, self.integrators + 1)[0])
        n = below.size - 1
        A = np.eye(n, k=1)
        A[-1] = -below[:0:-1] / below[0]
        C = np.zeros(n)
        C[: above.size] = above[::-1] / below[0]
        return A, np.eye(n)[-1], C


def _lags(family: str, name: str, lags: tuple[float, ...], dead_s: float = 0.0) -> Process:
    return Process(name, family, lags=lags, dead_time_s=dead_s)


def _integrating(name: str, lags: tuple[float, ...], dead_s: float) -> Process:
    return Process(name, "integrating", lags=lags, integrators=1, dead_time_s=dead_s)


_FIRST, _SECOND = "first order and dead time", "two lags and dead time"
_N, _FOUR, _ZERO = "n equal lags", "four lags", "zero in the right half plane"

PROCESSES: tuple[Process, ...] = (
    *(_lags(_FIRST, f"e^-s/({T:g}s+1)", (T,), 1.0) for T in (0.1, 0.5, 2.0, 10.0)),
    *(_lags(_SECOND, f"e^-s/({T:g}s+1)^2", (T, T), 1.0) for T in (0.3, 2.0)),
    _lags("three lags", "1/(s+1)(0.2s+1)^2", (1.0, 0.2, 0.2)),
    *(_lags(_N, f"1/(s+1)^{n}", (1.0,) * n) for n in (3, 8)),
    _lags(_FOUR, "1/(s+1)(.5s+1)(.25s+1)(.125s+1)", (1.0, 0.5, 0.25, 0.125)),
    *(
        _integrating(f"e^-{L:g}s/s({1.0 - L:g}s+1)", (1.0 - L,), L)
        for L in (0.05, 0.3)
    ),
    _integrating("e^-s/s", (), 1.0),
    _integrating("1/s(s+1)^2", (1.0, 1.0), 0.0),
    _integrating("e^-0.2s/s(0.5s+1)^3", (0.5, 0.5, 0.5), 0.2),
    *(
        Process(
            f"{T:g}e^-0.5s/({T:g}s+1)(0.5s+1)",
            "slow pole",
            lags=(T, 0.5),
            dead_time_s=0.5,
            gain=T,
        )
        for T in (1.0, 10.0)
    ),
    *(Process(f"(1-{z:g}s)/(s+1)^3", _ZERO, lags=(1.0,) * 3, zeros=(z,)) for z in (0.5, 1.1)),
    Process("1/(s+1)(0.09s^2+0.42s+1)", "oscillatory", lags=(1.0,), pair=(0.3, 0.7)),
    Process("e^-0.3s/(s^2+0.2s+1)", "oscillatory", pair=(1.0, 0.1), dead_time_s=0.3),
    Process(
        "e^-0.05s/(s-1)", UNSTABLE, lags=(-1.0,), gain=-1.0, dead_time_s=0.05,
        start=Gains(4.0, 1.0, 0.02, 0.05), settling_s=0.8,
    ),
    Process(
        "1/(s^2-1)", UNSTABLE, lags=(-1.0, 1.0), gain=-1.0,
        start=Gains(4.0, 1.0, 2.0, 0.1), settling_s=3.0,
    ),
    Process(
        "pendulum, rate loop", UNSTABLE, lags=(-1.0, 0.1), gain=-1.0,
        start=Gains(3.0, 1.0, 0.5, 0.1), settling_s=3.0,
    ),
    Process(
        "1/s^2", UNSTABLE, integrators=2,
        start=Gains(0.5, 0.05, 0.8, 0.1), settling_s=6.0,
    ),
    Process(
        "1/s^2(0.05s+1)", UNSTABLE, lags=(0.05,), integrators=2,
        start=Gains(0.5, 0.05, 0.8, 0.1), settling_s=6.0,
    ),
    Process(
        "1/s^2(0.3s+1)", UNSTABLE, lags=(0.3,), integrators=2,
        start=Gains(0.5, 0.05, 0.8, 0.1), settling_s=6.0,
    ),
)  # fmt: skip
