"""Cost, overshoot and stability margins that an identified loop predicts at any gains."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.core.response import StepShape
from estune.loop_model.model import ClosedLoop, LoopModel, close_loop, robustness
from estune.loop_model.sampled_loop import sampled_response


@dataclass(frozen=True)
class StepTrial:
    """A step trial without its gains.

    Attributes:
        controller: The fixed part of the controller.
        cost: The settings of (35).
        preload_N: Setpoint before the step.
        step: The step and the load.
        samples: Samples of the trial.
        effort_N: Effort at rest before the step, by which the controller's limits are judged.
    """

    controller: ControllerSettings
    cost: StepCost
    preload_N: float
    step: StepShape
    samples: int
    effort_N: float = 0.0

    @property
    def end(self) -> int:
        """Sample after the last one of the response to the step: the load's, or the end."""
        return self.samples if self.step.load is None else self.step.load.sample

    @cached_property
    def loads_N(self) -> FloatArray:
        """The load at each sample, shape (samples,)."""
        return self.step.loads(self.samples)

    @cached_property
    def setpoint_N(self) -> FloatArray:
        """The setpoint as a deviation from the preload, shape (samples,)."""
        return self.step.setpoint(self.samples)

    @cached_property
    def error_weight(self) -> float:
        """Cost of an error of the step's size in every sample."""
        rate = self.controller.sampling_Hz
        return float(self.cost.weights(rate, self.step, self.samples).sum())


class Prediction(NamedTuple):
    """Predictions by a model for one set of gains; cost and Ms are infinite where it is unstable.

    Attributes:
        cost: Expected cost of a trial, with the noise's share.
        overshoot: Of the response without noise, as a share of the step.
        sensitivity: Ms.
        phase_margin_deg: Phase margin, degrees.
    """

    cost: float
    overshoot: float
    sensitivity: float
    phase_margin_deg: float


UNSTABLE = Prediction(math.inf, math.inf, math.inf, math.nan)


def predict(model: LoopModel, trial: StepTrial, gains: Gains, noise_N: float = 0.0) -> Prediction:
    """The predictions by a model of a step trial with these gains."""
    margins = robustness(model, gains, trial.controller)
    if not math.isfinite(margins.sensitivity):
        return UNSTABLE
    loop = close_loop(model, gains, trial.controller)
    output, effort = _response(model, loop, trial, gains)
    peak = float(np.max(output[trial.step.sample : trial.end] / trial.step.size_N)) - 1.0
    return Prediction(
        cost=_expected_cost(loop, trial, output, effort, noise_N),
        overshoot=max(peak, 0.0),
        sensitivity=margins.sensitivity,
        phase_margin_deg=margins.phase_margin_deg,
    )


def expected_response(model: LoopModel, trial: StepTrial, gains: Gains) -> FloatArray:
    """The response to a step trial as a deviation, without noise, shape (samples,)."""
    return _response(model, close_loop(model, gains, trial.controller), trial, gains)[0]


def _response(
    model: LoopModel, loop: ClosedLoop, trial: StepTrial, gains: Gains
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations; by samples only with friction, or where limits act."""
    settings = trial.controller
    if not model.friction_N:
        output, effort = loop.setpoint_response(trial.setpoint_N)
        if trial.step.load:
            loaded = loop.load_response(trial.loads_N)
            output, effort = output + loaded[0], effort + loaded[1]
        total = effort + trial.effort_N
        if settings.output_min_N <= total.min() and total.max() <= settings.output_max_N:
            return output, effort
    return sampled_response(
        model, settings, gains, trial.setpoint_N, trial.loads_N, rest_effort_N=trial.effort_N
    )


def _expected_cost(
    loop: ClosedLoop, trial: StepTrial, output: FloatArray, effort: FloatArray, noise_N: float
) -> float:
    """Cost of a response with the measurement noise in it.

    Where the share of the noise is not known from the weights of the error, it is the mean over
    one fixed sequence of noise and its negative, which leaves out the terms of odd order.
    """

    def cost(measurement: FloatArray, command: FloatArray) -> float:
        columns = trial.setpoint_N, measurement, command
        rate = trial.controller.sampling_Hz
        return float(trial.cost.evaluate(rate, trial.step, *columns))

    if noise_N == 0.0:
        return cost(output, effort)
    if trial.cost.is_quadratic and trial.step.load is None:
        return cost(output, effort) + _noise_cost(loop, trial, noise_N)
    y, u = loop.noise_response(noise_N * fixed_noise(trial.samples))
    return 0.5 * (cost(output + y, effort + u) + cost(output - y, effort - u))


@lru_cache(maxsize=16)
def fixed_noise(samples: int) -> FloatArray:
    """White noise of standard deviation one, the same at all gains."""
    return np.random.default_rng(0).standard_normal(samples)


def _noise_cost(loop: ClosedLoop, trial: StepTrial, noise_N: float) -> float:
    """Expected share of the measurement noise in a quadratic cost."""
    after = trial.samples - trial.step.sample
    error, move = loop.noise_gains(after)
    return (noise_N / trial.step.size_N) ** 2 * (
        trial.error_weight * error + trial.cost.move_weight * after * move
    )
