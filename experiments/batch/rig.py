"""A rig of a process: it answers trial requests by the loop of `loop`, with noise."""

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.trial import Outcome, RigDescription, RigLimits, TrialRecord, TrialRequest
from estune.trial.profiles import LoadStepProfile, StepProfile
from estune.trial.records import record_of
from experiments.batch.loop import FILTER_SAMPLES, Loop

REACH, LOAD_MAX, LONGEST = 50.0, 100.0, 10.0
"""Largest measurement and load, in steps, and longest trial, in trials of the tuning."""


class BatchRig:
    """The rig of a process; it tells nothing of its model.

    Args:
        loop: The loop.
        start: Its live gains.
        seed: Of the noise, which depends on the number of the trial beside it.
    """

    def __init__(self, loop: Loop, start: Gains, seed: int) -> None:
        self._loop, self._seed, self.trials = loop, seed, 0
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
        load = np.zeros(setpoint.size)
        if isinstance(request.profile, LoadStepProfile):
            load = request.profile.shape(rate).loads(setpoint.size)
        self.trials += 1
        rng = np.random.default_rng([self._seed, request.number])
        noise = self._loop.noise * rng.standard_normal(setpoint.size)
        m = self._loop.matrices(request.gains)
        inputs = np.stack([setpoint, noise, load])
        driving = np.stack([m.setpoint, m.noise, m.load], axis=1)
        z = np.zeros(m.output.size)
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

    def apply(self, gains: Gains) -> None:
        """Nothing: no tuning calls it."""

    def close(self) -> None:
        """Nothing is open."""
