"""Cost, overshoot and stability margins that an identified loop predicts at any gains."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.core.response import StepShape
from estune.loop_model import margins
from estune.loop_model.model import ClosedLoop, LoopModel, close_loop
from estune.loop_model.sampled_loop import sampled_response


@dataclass(frozen=True)
class StepTrial:
    """A step trial without its gains.

    Attributes:
        rest_effort: Effort at rest before the step, by which the controller's limits are judged.
    """

    controller: ControllerSettings
    cost: StepCost
    preload: float
    step: StepShape
    samples: int
    rest_effort: float = 0.0

    @property
    def end(self) -> int:
        """Sample after the last one of the response to the step: the load's, or the end."""
        return self.samples if self.step.load is None else self.step.load.sample

    @cached_property
    def loads(self) -> FloatArray:
        """The load at each sample, shape (samples,)."""
        return self.step.loads(self.samples)

    @cached_property
    def setpoint(self) -> FloatArray:
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
        peaks: Largest |S| in each band of frequency.
    """

    cost: float
    overshoot: float
    sensitivity: float
    phase_margin_deg: float
    peaks: tuple[float, ...]


SEQUENCES = 8
"""Sequences of noise by which the scatter of a cost is estimated, to a quarter."""

UNSTABLE = Prediction(math.inf, math.inf, *margins.UNSTABLE)


def predict(
    model: LoopModel, trial: StepTrial, gains: Gains, noise_std: float = 0.0
) -> Prediction:
    """The predictions by a model of a step trial with these gains."""
    return predictions([model], trial, [gains], noise_std)[0]


def predictions(
    models: Sequence[LoopModel],
    trial: StepTrial,
    gains: Sequence[Gains],
    noise_std: float = 0.0,
) -> list[Prediction]:
    """The predictions of a step trial by several models, or with several gains.

    Args:
        models: Of one order and dead time; one for all gains, or one for each.
        trial: The step trial.
        gains: One for all models, or one for each.
        noise_std: Standard deviation of the measurement noise.
    """
    robust = margins.robustness_of(models, gains, trial.controller)
    found = [UNSTABLE] * len(robust)
    stable = [i for i, one in enumerate(robust) if math.isfinite(one.sensitivity)]
    if not stable:
        return found
    pairs = [(models[i % len(models)], gains[i % len(gains)]) for i in stable]
    loops = [close_loop(model, at, trial.controller) for model, at in pairs]
    responses = [
        _response(model, loop, trial, at) for (model, at), loop in zip(pairs, loops, strict=True)
    ]
    output, effort = (np.array(signals) for signals in zip(*responses, strict=True))
    costs = _expected_costs(loops, trial, output, effort, noise_std)
    tops = np.max(output[:, trial.step.sample : trial.end] / trial.step.size, axis=1) - 1.0
    for i, cost, top in zip(stable, costs.tolist(), tops.tolist(), strict=True):
        found[i] = Prediction(cost, max(top, 0.0), *robust[i])
    return found


def expected_response(model: LoopModel, trial: StepTrial, gains: Gains) -> FloatArray:
    """The response to a step trial as a deviation, without noise, shape (samples,)."""
    return _response(model, close_loop(model, gains, trial.controller), trial, gains)[0]


def _response(
    model: LoopModel, loop: ClosedLoop, trial: StepTrial, gains: Gains
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations; by samples only with friction, or where limits act."""
    settings = trial.controller
    if not model.friction:
        output, effort = loop.setpoint_response(trial.setpoint)
        if trial.step.load:
            loaded = loop.load_response(trial.loads)
            output, effort = output + loaded[0], effort + loaded[1]
        total = effort + trial.rest_effort
        if settings.output_min_N <= total.min() and total.max() <= settings.output_max_N:
            return output, effort
    return sampled_response(
        model, settings, gains, trial.setpoint, trial.loads, rest_effort=trial.rest_effort
    )


def cost_deviation(model: LoopModel, trial: StepTrial, gains: Gains, noise_std: float) -> float:
    """Standard deviation of the cost of one trial of a stable loop by its measurement noise."""
    loop = close_loop(model, gains, trial.controller)
    response = _response(model, loop, trial, gains)
    noise = noise_std * fixed_noise(SEQUENCES * trial.samples).reshape(SEQUENCES, trial.samples)
    pairs = [loop.noise_response(one) for one in noise]
    y, u = (np.array(signals) for signals in zip(*pairs, strict=True))
    columns = trial.setpoint, response[0] + y, response[1] + u
    costs = trial.cost.evaluate(trial.controller.sampling_Hz, trial.step, *columns)
    return float(np.std(costs, ddof=1))


def _expected_costs(
    loops: Sequence[ClosedLoop],
    trial: StepTrial,
    output: FloatArray,
    effort: FloatArray,
    noise_std: float,
) -> FloatArray:
    """Costs of responses with the measurement noise in them, shape (loops,).

    Where the share of the noise is not known from the weights of the error, it is the mean over
    one fixed sequence of noise and its negative, which leaves out the terms of odd order.
    """

    def cost(measurement: FloatArray, command: FloatArray) -> FloatArray:
        columns = trial.setpoint, measurement, command
        rate = trial.controller.sampling_Hz
        return np.asarray(trial.cost.evaluate(rate, trial.step, *columns))

    if noise_std == 0.0:
        return cost(output, effort)
    if trial.cost.is_quadratic and trial.step.load is None:
        shares = np.array([_noise_cost(loop, trial, noise_std) for loop in loops])
        return np.asarray(cost(output, effort) + shares)
    noise = noise_std * fixed_noise(trial.samples)
    both = [loop.noise_response(noise) for loop in loops]
    y, u = (np.array(signals) for signals in zip(*both, strict=True))
    return np.asarray(0.5 * (cost(output + y, effort + u) + cost(output - y, effort - u)))


@lru_cache(maxsize=16)
def fixed_noise(samples: int) -> FloatArray:
    """White noise of standard deviation one, the same at all gains."""
    return np.random.default_rng(0).standard_normal(samples)


def _noise_cost(loop: ClosedLoop, trial: StepTrial, noise_std: float) -> float:
    """Expected share of the measurement noise in a quadratic cost."""
    after = trial.samples - trial.step.sample
    error, move = loop.noise_gains(after)
    return (noise_std / trial.step.size) ** 2 * (
        trial.error_weight * error + trial.cost.move_weight * after * move
    )
