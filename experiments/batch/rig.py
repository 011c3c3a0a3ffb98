"""A rig of a process: it answers trial requests by the loop of `loop`, with noise and loads."""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.trial import RigLimits, TrialRequest
from estune.trial.profiles import LoadStepProfile, StepProfile
from experiments.batch.loop import FILTER_SAMPLES, ProcessLoop, convolved, driven, impulse
from experiments.written_rig import WrittenRig

REACH, LOAD_MAX, LONGEST = 50.0, 100.0, 10.0
"""Largest measurement and load, in steps, and longest trial, in trials of the tuning."""

LOADED = 0.2
"""Share of the trials with a load step."""


class Disturbance(NamedTuple):
    """What acts on the loop beside the trial.

    Attributes:
        load: Standard deviation of the measurement at rest, with the initial gains, by a load of
            first order with a time constant of half a settling time; as a share of the step.
        steps: Largest deviation by a load step in one trial of five, likewise.
        drift: Drift of the sensor over a trial, as a share of the step, of either sign.
    """

    load: float = 0.0
    steps: float = 0.0
    drift: float = 0.0


class BatchRig(WrittenRig):
    """The rig of a process; it tells nothing of its model.

    Args:
        loop: The loop.
        start: Its live gains.
        seed: Of noise and loads, which depend on the number of the trial beside it.
        disturbance: What acts beside the trial.
    """

    def __init__(
        self, loop: ProcessLoop, start: Gains, seed: int, disturbance: Disturbance | None = None
    ) -> None:
        self._loop, self._seed = loop, seed
        self._disturbance = disturbance or Disturbance()
        self._load_scale, self._step_scale = self._scales(start)
        h, count = loop.h, loop.before + loop.after
        super().__init__(
            name="batch",
            start=start,
            controller=ControllerSettings(1.0 / h, FILTER_SAMPLES * h, -np.inf, np.inf),
            limits=RigLimits(-REACH, REACH, LONGEST * count * h, LOAD_MAX),
            step=StepProfile(0.0, 1.0, loop.before * h, count * h),
            settling_time_s=loop.process.settling_time_s,
        )

    def answer(self, request: TrialRequest, setpoint: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort of a trial; with those of the load before it in the state."""
        noise, load = self._acting(setpoint.size, request.number)
        before, load = load[: -setpoint.size], load[-setpoint.size :]
        if isinstance(request.profile, LoadStepProfile):
            load = load + request.profile.shape(1.0 / self._loop.h).loads(setpoint.size)
        m = self._loop.matrices(request.gains)
        inputs = np.stack([setpoint, noise, load])
        driving = np.stack([m.setpoint, m.noise, m.load], axis=1)
        z = np.zeros(m.output.size)
        for value in before:  # the loop has met the load before the trial
            z = m.M @ z + m.load * value
        output, effort = np.zeros(setpoint.size), np.zeros(setpoint.size)
        for k in range(setpoint.size):
            output[k] = m.output @ z + noise[k]
            effort[k] = m.effort @ z + m.effort_of_setpoint * setpoint[k]
            effort[k] += m.effort_of_noise * noise[k]
            if not abs(output[k]) <= REACH:
                return output[: k + 1], effort[: k + 1]
            z = m.M @ z + driving @ inputs[:, k]
        return output, effort

    @property
    def _pole(self) -> float:
        """Of the coloured load."""
        return float(np.exp(-2.0 * self._loop.h / self._loop.process.settling_time_s))

    def _scales(self, start: Gains) -> tuple[float, float]:
        """Driving noise, and load step, per deviation of the measurement."""
        m = self._loop.matrices(start)
        count = 8 * self._loop.after
        answer = impulse(m.M, m.load, count) @ m.output
        coloured = convolved(answer[None], np.power(self._pole, np.arange(float(count))))[0]
        return 1.0 / float(np.linalg.norm(coloured)), 1.0 / float(np.abs(np.cumsum(answer)).max())

    def _acting(self, count: int, number: int) -> tuple[FloatArray, FloatArray]:
        """Noise of a trial, shape (count,), and loads before it and in it, (before + count,)."""
        rng = np.random.default_rng([self._seed, number])
        noise = self._loop.noise * rng.standard_normal(count)
        if not any(self._disturbance):
            return noise, np.zeros(count)
        size, settled = self._disturbance.load * self._load_scale, 2 * self._loop.after
        white = size * rng.standard_normal(settled + count)
        load = np.asarray(lfilter([1.0], [1.0, -self._pole], white))
        if rng.random() < LOADED:
            at, sign = int(rng.uniform(0.15, 0.9) * count), rng.choice([-1.0, 1.0])
            load[settled + at :] += sign * self._disturbance.steps * self._step_scale
        drift = self._disturbance.drift * rng.choice([-1.0, 1.0])
        return noise + drift * np.linspace(0.0, 1.0, count), load[self._loop.after :]

    def costs(self, gains: Gains, cost: StepCost, trials: int) -> FloatArray:
        """Costs of step trials of some gains, with what acts on them, shape (trials,)."""
        step, rate, m = self._description.step, 1.0 / self._loop.h, self._loop.matrices(gains)
        setpoint = step.setpoint(rate)
        count, after = setpoint.size, setpoint.size - self._loop.before
        rows = zip(*(self._acting(count, number) for number in range(trials)), strict=True)
        noise, load = (np.array(row) for row in rows)
        states = np.zeros((count, m.output.size))
        states[-after:] = driven(m.M, m.setpoint, after)
        output = states @ m.output + noise
        effort = states @ m.effort + m.effort_of_setpoint * setpoint + m.effort_of_noise * noise
        for acting, by in ((noise, m.noise), (load, m.load)):
            answer = impulse(m.M, by, acting.shape[1])
            output = output + convolved(acting, answer @ m.output)[:, -count:]
            effort = effort + convolved(acting, answer @ m.effort)[:, -count:]
        return np.asarray(cost.evaluate(rate, step.shape(rate), setpoint, output, effort))
