"""A computed rig and a scripted tuner, for tests of runs."""

from dataclasses import replace

import numpy as np

from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.run.planning import known_start
from estune.studies.law.start import start_from
from estune.trial import (
    Outcome,
    RigDescription,
    RigLimits,
    TrialRecord,
    TrialRequest,
)
from estune.trial.profiles import StepProfile
from estune.tuners.interface import ConvergenceEstimate, CostPrediction
from estune.tuners.least_squares_gradient import LeastSquaresGradient

START = Gains(0.5, 10.0, 0.005, 0.02)


def description(**changes) -> RigDescription:
    plain = RigDescription(
        name="arithmetic",
        gains=START,
        controller=ControllerSettings(100.0, 0.002, -100.0, 100.0),
        newtons_per_ampere=20.0,
        limits=RigLimits(0.0, 50.0, 5.0),
        step=StepProfile(10.0, 10.0, 0.1, 0.6),
        settling_time_s=0.2,
    )
    return replace(plain, **changes)


class ArithmeticRig:
    """Rig with a first-order response that is fastest at certain gains, with 1 % noise.

    Like the simulated rig, its noise depends on the trial's number alone.
    """

    best = Gains(1.0, 40.0, 0.02, 0.01)

    def __init__(self, **changes) -> None:
        self.description = description(**changes)
        self.requests: list[TrialRequest] = []
        self.closed = False

    def describe(self) -> RigDescription:
        return self.description

    def run(self, request: TrialRequest) -> TrialRecord:
        self.requests.append(request)
        away = np.log(np.divide(request.gains.as_tuple(), self.best.as_tuple()))
        lag_s = 0.03 * (1.0 + float(away @ away))
        step, rate = request.profile, self.description.controller.sampling_Hz
        time = np.arange(step.samples(rate)) / rate
        since = np.maximum(time - step.step_at_s, 0.0)
        noise = np.random.default_rng(request.number).normal(
            0.0, 0.01 * abs(step.step_N), time.size
        )
        tension = step.preload_N + step.step_N * (1.0 - np.exp(-since / lag_s)) + noise
        return TrialRecord(
            trial_id=request.trial_id,
            rig=self.description.name,
            sampling_Hz=rate,
            cable_length_m=None,
            preload_N=step.preload_N,
            gains=request.gains,
            outcome=Outcome.DONE,
            reason="",
            started_at="2009-05-04T12:00:00+00:00",
            software="test",
            time_s=time,
            setpoint_N=step.setpoint(rate),
            tension_N=tension,
            current_A=tension / self.description.newtons_per_ampere,
            angle_rad=np.zeros_like(time),
            flags=np.zeros(time.size, np.uint8),
        )

    def apply(self, gains: Gains) -> None:
        self.description = replace(self.description, gains=gains)

    def abort(self) -> RigDescription:
        return self.description

    def close(self) -> None:
        self.closed = True


class Seer(LeastSquaresGradient):
    """Tuner with scripted remaining improvement and a scripted explored region."""

    def convergence(self, state):
        remaining = (1.0, 0.3, 0.01, 0.01, 0.3, *(0.01,) * 50)[state.k - 1]
        return ConvergenceEstimate(0.01, remaining, remaining / 2.0, ((0.1, 1.0),) * 4)

    def predict(self, _state, point):
        return CostPrediction(1.0, 0.5, 2.0, explored=point[0] < START.P)


def start_for(source, rig):
    """The initial gains of a source for a rig's own step, with the default cost and limits."""
    cost = default_cost(rig.settling_time_s).scaled(rig.effort_scale)
    return known_start(start_from(source), rig, rig.step, cost, None)
