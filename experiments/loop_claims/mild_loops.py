"""Loops that are mildly nonlinear or change, simulated without any part of the plants.

A mass on a spring, w = 2 pi f, driven by the effort v and measured by a sensor,

    y'' = w^2 (v - s(y) - F(y')) - 2 d w y',      m = c(y),

whose spring s, friction F, sensor c, drive v(u), or frequency and gain from trial to trial are
drawn by the seed. Four substeps per sample; the spring is 1 N/N, so that the step is one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings, PidfState, coefficients, step
from estune.core.quantities import FloatArray
from estune.trial import RigLimits, TrialRequest
from estune.trial.profiles import StepProfile
from experiments.written_rig import WrittenRig

SAMPLING_HZ, SUBSTEPS = 632.0, 4
FILTER_S = 1.0 / (2.0 * math.pi * 80.0)
PERIODS, BEFORE = 6.0, 0.6
"""Length of a trial after its step, and before it, in periods of the mass."""

WIDE = 4.0
"""Limit of the effort, in steps, where nothing else is drawn."""

REACH = 20.0
"""Measurement, in steps, at which a trial ends."""

DRIFT_TRIALS = 40
"""Trials in which a drift is complete."""

LOADED = 0.2
"""Share of the trials with a load step."""

STEEPEST = 0.05
"""Velocity of Stribeck's fall, in steps times w."""

THETA = np.concatenate([np.geomspace(1e-4, 0.2, 1500), np.linspace(0.2, math.pi, 800)])
"""Frequencies at which Ms is read, rad/sample."""


@dataclass(frozen=True)
class Mild:
    """A loop of a seed.

    Attributes:
        name: What is not linear or not constant.
        frequency_Hz: f.
        damping: d.
        dead: Dead time in samples.
        noise: Standard deviation of the noise, as a share of the step.
        coulomb: Dry friction, as a share of the step's effort.
        sticking: Friction at rest over it, for Stribeck's law.
        stiffening: Slope of the spring at the end of the step over that before it.
        sensor: Slope of the sensor at the end of the step over that before it.
        saturation: Largest effort, in steps.
        play: Width of a play between drive and spring, in steps.
        drift: Share by which the gain of the drive changes in `DRIFT_TRIALS`.
        varying: Standard deviation of the gain of the drive from trial to trial.
        load: Load step in one trial of five, as a share of the step.
    """

    name: str
    frequency_Hz: float
    damping: float
    dead: int
    noise: float
    coulomb: float = 0.0
    sticking: float = 1.0
    stiffening: float = 1.0
    sensor: float = 1.0
    saturation: float = WIDE
    play: float = 0.0
    drift: float = 0.0
    varying: float = 0.0
    load: float = 0.0

    @property
    def settings(self) -> ControllerSettings:
        """The fixed part of the controller."""
        return ControllerSettings(SAMPLING_HZ, FILTER_S, -WIDE, WIDE)

    @property
    def profile(self) -> StepProfile:
        """The step trial."""
        period_s = 1.0 / self.frequency_Hz
        return StepProfile(0.0, 1.0, BEFORE * period_s, (BEFORE + PERIODS) * period_s)

    @property
    def start(self) -> Gains:
        """Slow initial gains."""
        f = self.frequency_Hz
        return Gains(0.15, 0.8 * f, 0.012 / f, 0.3 / f)

    def gain_in(self, number: int, chance: float = 0.0) -> float:
        """Gain of the drive in a trial, by a normal variable."""
        drifted = 1.0 + self.drift * min(number / DRIFT_TRIALS, 1.0)
        return drifted * math.exp(self.varying * chance)

    def simulated(
        self, gains: Gains, setpoint: FloatArray, noise: FloatArray, load: FloatArray, gain: float
    ) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort of a trial from rest at zero, shape (samples,) each.

        They end with the first measurement beyond `REACH`.
        """
        law, w = coefficients(self.settings, gains), math.tau * self.frequency_Hz
        h = 1.0 / (SAMPLING_HZ * SUBSTEPS)
        position = velocity = played = 0.0
        state, late = PidfState(0.0, 0.0, 0.0), [0.0] * (self.dead + 1)
        measured, efforts = np.zeros(setpoint.size), np.zeros(setpoint.size)
        bent, curved, half = self.stiffening - 1.0, self.sensor - 1.0, 0.5 * self.play
        for k in range(setpoint.size):
            measured[k] = position * (1.0 + 0.5 * curved * position) + noise[k]
            if not abs(measured[k]) <= REACH:
                return measured[: k + 1], efforts[: k + 1]
            state, efforts[k], _ = step(law, state, float(setpoint[k]), float(measured[k]))
            late = [*late[1:], float(efforts[k])]
            drive = gain * min(max(late[0], -self.saturation), self.saturation) + load[k]
            played = min(max(played, drive - half), drive + half)
            for _ in range(SUBSTEPS):
                spring = position * (1.0 + 0.5 * bent * position)
                damped = 2.0 * self.damping * w * velocity
                free = velocity + h * (w * w * (played - spring) - damped)
                falls = math.exp(-((velocity / (STEEPEST * w)) ** 2))
                most = h * w * w * self.coulomb * (1.0 + (self.sticking - 1.0) * falls)
                velocity = free - min(max(free, -most), most)
                position += h * velocity
        return measured, efforts

    def sensitivity(self, gains: Gains, number: int) -> float:
        """Ms of the linear part at the end of the step after so many trials.

        Without friction, play, saturation and what varies from trial to trial. Infinite where the
        loop is unstable.
        """
        w, h = math.tau * self.frequency_Hz, 1.0 / SAMPLING_HZ
        k, curved = h / SUBSTEPS, self.sensor - 1.0
        end = (math.sqrt(1.0 + 2.0 * curved) - 1.0) / curved if curved else 1.0
        slope, damped = 1.0 + (self.stiffening - 1.0) * end, 1.0 - 2.0 * self.damping * w * k
        one = np.array([[1.0 - (k * w) ** 2 * slope, k * damped], [-k * w * w * slope, damped]])
        Phi, Gamma = np.eye(2), np.zeros(2)
        for _ in range(SUBSTEPS):
            Phi, Gamma = one @ Phi, one @ Gamma + np.array([(k * w) ** 2, k * w * w])
        A = np.poly(Phi)
        seen = self.gain_in(number) * (1.0 + curved * end)
        B = seen * (np.poly(Phi - np.outer(Gamma, [1.0, 0.0])) - A)
        integral, lag = np.array([1.0, -1.0]), np.array([FILTER_S + h, -FILTER_S])
        proportional = gains.P * np.polymul(integral, lag)
        law = np.polyadd(proportional, gains.I * h * lag)
        law = np.polyadd(law, gains.D * np.polymul(integral, integral))
        below = np.polymul(np.polymul(A, np.polymul(integral, lag)), [1.0, *[0.0] * self.dead])
        closed = np.polyadd(below, np.polymul(B, law))
        if np.abs(np.roots(closed)).max() >= 1.0:
            return math.inf
        z = np.exp(1j * THETA)
        return float(np.abs(np.polyval(below, z) / np.polyval(closed, z)).max())

    def overshoot(self, gains: Gains, number: int) -> float:
        """Overshoot of the step without noise and load, as a share."""
        setpoint = self.profile.setpoint(SAMPLING_HZ)
        quiet = np.zeros(setpoint.size)
        y, _ = self.simulated(gains, setpoint, quiet, quiet, self.gain_in(number))
        return max(float(y.max()) - 1.0, 0.0) if y.size == setpoint.size else math.inf


KINDS: dict[str, Callable[[float], dict[str, Any]]] = {
    "Coulomb friction, weak": lambda x: {"coulomb": 0.005 + 0.015 * x},
    "Coulomb friction": lambda x: {"coulomb": 0.02 + 0.03 * x},
    "Coulomb friction, strong": lambda x: {"coulomb": 0.05 + 0.07 * x},
    "Stribeck friction": lambda x: {"coulomb": 0.01 + 0.02 * x, "sticking": 2.0},
    "drift down": lambda x: {"drift": -0.1 - 0.2 * x},
    "drift up": lambda x: {"drift": 0.1 + 0.5 * x},
    "gain varies little": lambda x: {"varying": 0.02 + 0.04 * x},
    "gain varies": lambda x: {"varying": 0.06 + 0.09 * x},
    "load in one of five": lambda x: {"load": 0.05 + 0.15 * x},
    "stiffening": lambda x: {"stiffening": 1.1 + 0.5 * x},
    "stiffening, strong": lambda x: {"stiffening": 1.6 + 0.9 * x},
    "softening": lambda x: {"stiffening": 0.9 - 0.3 * x},
    "sensor steepens": lambda x: {"sensor": 1.1 + 0.4 * x},
    "sensor flattens": lambda x: {"sensor": 0.95 - 0.25 * x},
    "saturation, near": lambda x: {"saturation": 1.05 + 0.2 * x},
    "saturation": lambda x: {"saturation": 1.25 + 0.5 * x},
    "saturation, far": lambda x: {"saturation": 1.75 + 0.75 * x},
    "play": lambda x: {"play": 0.01 + 0.04 * x},
}
"""The kinds of loops, which seeds take in turn, by a number between zero and one."""


def drawn(seed: int) -> Mild:
    """The loop of a seed."""
    rng = np.random.default_rng([23, seed])
    kind, x = list(KINDS)[seed % len(KINDS)], float(rng.random())
    return Mild(
        kind,
        frequency_Hz=math.exp(rng.uniform(math.log(3.0), math.log(9.0))),
        damping=math.exp(rng.uniform(math.log(0.1), math.log(0.6))),
        dead=int(rng.integers(1, 5)),
        noise=math.exp(rng.uniform(math.log(0.001), math.log(0.005))),
        **KINDS[kind](x),
    )


class MildRig(WrittenRig):
    """A rig of such a loop.

    Args:
        loop: The loop.
        seed: Of noise, loads and gains, which depend on the number of the trial beside it.
    """

    def __init__(self, loop: Mild, seed: int) -> None:
        self._loop, self._seed = loop, seed
        super().__init__(
            name="mild",
            start=loop.start,
            controller=loop.settings,
            limits=RigLimits(-REACH, REACH, 100.0),
            step=loop.profile,
            settling_time_s=1.0 / loop.frequency_Hz,
        )

    def answer(self, request: TrialRequest, setpoint: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort of a trial."""
        loop, rng = self._loop, np.random.default_rng([29, self._seed, request.number])
        noise, load = loop.noise * rng.standard_normal(setpoint.size), np.zeros(setpoint.size)
        gain = loop.gain_in(request.number, float(rng.standard_normal()))
        if rng.random() < LOADED:
            load[int(rng.uniform(0.2, 0.9) * load.size) :] = loop.load * rng.choice([-1.0, 1.0])
        return loop.simulated(request.gains, setpoint, noise, load, gain)
