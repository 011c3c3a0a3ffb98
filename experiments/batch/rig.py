"""A rig of a process: it answers trial requests by the loop of `loop`, with noise and loads."""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.trial import Outcome, RigDescription, RigLimits, TrialRecord, TrialRequest
from estune.trial.profiles import LoadStepProfile, StepProfile
from estune.trial.records import record_of
from experiments.batch.loop import FILTER_SAMPLES, ProcessLoop, convolved, impulse

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


class BatchRig:
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
        self._loop, self._seed, self.trials = loop, seed, 0
        self._disturbance = disturbance or Disturbance()
        self._load_scale, self._step_scale = self._scales(start)
        h, count = loop.h, loop.before + loop.after
        self._description = RigDescription(
            name="batch",
            gains=start,
            controller=ControllerSettings(1.0 / h, FILTER_SAMPLES * h, -np.inf, np.inf),
            newtons_per_ampere=1.0,
            limits=RigLimits(-REACH, REACH, LONGEST * count * h, LOAD_MAX),
            step=StepProfile(0.0, 1.0, loop.before * h, count * h),
            settling_time_s=loop.process.settling_time_s,
            simulated=True,
            measurement="measurement",
            command="control effort",
        )

    def describe(self) -> RigDescription:
        """Its description."""
        return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        """One trial; ends as diverged where the measurement leaves `REACH`."""
        rate = self._description.controller.sampling_Hz
        setpoint = request.profile.setpoint(rate)
        load, before = np.zeros(setpoint.size), np.zeros(0)
        if isinstance(request.profile, LoadStepProfile):
            load = request.profile.shape(rate).loads(setpoint.size)
        self.trials += 1
        rng = np.random.default_rng([self._seed, request.number])
        noise = self._loop.noise * rng.standard_normal(setpoint.size)
        if any(self._disturbance):
            before, own = self._loads(setpoint.size, rng)
            load += own
            drift = self._disturbance.drift * rng.choice([-1.0, 1.0])
            noise += drift * np.linspace(0.0, 1.0, setpoint.size)
        m = self._loop.matrices(request.gains)
        inputs = np.stack([setpoint, noise, load])
        driving = np.stack([m.setpoint, m.noise, m.load], axis=1)
        z = np.zeros(m.output.size)
        for value in before:  # the loop has met the load before the trial
            z = m.M @ z + m.load * value
        output, effort = np.zeros(setpoint.size), np.zeros(setpoint.size)
        count = setpoint.size
        for k in range(setpoint.size):
            output[k] = m.output @ z + noise[k]
            effort[k] = m.effort @ z + m.effort_of_setpoint * setpoint[k]
            effort[k] += m.effort_of_noise * noise[k]
            if not abs(output[k]) <= REACH:
                count = k + 1
                break
            z = m.M @ z + driving @ inputs[:, k]
        ended = count < setpoint.size
        return record_of(
            *(request, self._description, Outcome.DIVERGED if ended else Outcome.DONE),
            *("the measurement left its range" if ended else "", "2006-01-01T00:00:00+00:00"),
            time_s=np.arange(count) / rate,
            setpoint_N=setpoint[:count],
            tension_N=output[:count],
            current_A=effort[:count],
            angle_rad=np.zeros(count),
            flags=np.zeros(count, np.uint8),
        )

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

    def _loads(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """The loads before a trial and in it, shape (samples,) each."""
        size, settled = self._disturbance.load * self._load_scale, 2 * self._loop.after
        white = size * rng.standard_normal(settled + count)
        coloured = np.asarray(lfilter([1.0], [1.0, -self._pole], white))
        before, load = coloured[self._loop.after : settled], coloured[settled:]
        if rng.random() < LOADED:
            at, sign = int(rng.uniform(0.15, 0.9) * count), rng.choice([-1.0, 1.0])
            load[at:] += sign * self._disturbance.steps * self._step_scale
        return before, load

    def apply(self, gains: Gains) -> None:
        """Nothing: no tuning calls it."""

    def close(self) -> None:
        """Nothing is open."""
