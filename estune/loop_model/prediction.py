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
from estune.loop_model.closed_loops import ClosedLoops, Inputs
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
        gains: One for all models, or one for each.
        noise_std: Standard deviation of the measurement noise.
    """
    by_variance = trial.cost.is_quadratic and trial.step.load is None
    begin = trial.step.sample
    noise = None if by_variance else noise_std * fixed_noise(trial.samples)
    load = trial.loads[begin:] if trial.step.load else None
    inputs = Inputs(begin, trial.setpoint[begin:], load, noise)
    compiled = margins.compiled_loops(models, gains, trial.controller, inputs)
    robust = compiled[0] if compiled else margins.robustness_of(models, gains, trial.controller)
    found = [UNSTABLE] * len(robust)
    stable = [i for i, one in enumerate(robust) if math.isfinite(one.sensitivity)]
    if not stable:
        return found
    pairs = [(models[i % len(models)], gains[i % len(gains)]) for i in stable]
    if compiled:
        output, effort, answers = _compiled_responses(pairs, trial, compiled[1], stable)
    else:
        loops = [close_loop(model, at, trial.controller) for model, at in pairs]
        responses = [
            _response(model, loop, trial, at)
            for (model, at), loop in zip(pairs, loops, strict=True)
        ]
        output, effort = (np.array(signals) for signals in zip(*responses, strict=True))
        answers = np.array(
            [
                loop.noise_gains(trial.samples - begin)
                if noise is None
                else loop.noise_response(noise)
                for loop in loops
            ]
        )
    costs = _expected_costs(trial, output, effort, answers, noise_std)
    tops = np.max(output[:, trial.step.sample : trial.end] / trial.step.size, axis=1) - 1.0
    for i, cost, top in zip(stable, costs.tolist(), tops.tolist(), strict=True):
        found[i] = Prediction(cost, max(top, 0.0), *robust[i])
    return found


def _compiled_responses(
    pairs: Sequence[tuple[LoopModel, Gains]],
    trial: StepTrial,
    loops: ClosedLoops,
    stable: Sequence[int],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Outputs and efforts of stable loops, shape (loops, samples), and what noise adds to them.

    By samples those with friction or a bend, or where limits act.
    """
    settings, rest = trial.controller, trial.rest_effort
    output, effort, noise = loops[-3:]
    if len(stable) < len(output):
        output, effort, noise = (one[stable] for one in loops[-3:])
    least, most = effort.min(axis=1) + rest, effort.max(axis=1) + rest
    free = (settings.output_min_N <= least) & (most <= settings.output_max_N)
    for i, (model, gains) in enumerate(pairs):
        if model.friction or not free[i] or not model.bend.is_straight:
            loop = close_loop(model, gains, settings)
            output[i], effort[i] = _response(model, loop, trial, gains)
    return output, effort, noise


def expected_response(model: LoopModel, trial: StepTrial, gains: Gains) -> FloatArray:
    """The response to a step trial as a deviation, without noise, shape (samples,)."""
    return _response(model, close_loop(model, gains, trial.controller), trial, gains)[0]


def _response(
    model: LoopModel, loop: ClosedLoop, trial: StepTrial, gains: Gains
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations; by samples with friction, a bend, or where limits act."""
    settings = trial.controller
    if not model.friction and model.bend.is_straight:
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


def _expected_costs(
    trial: StepTrial,
    output: FloatArray,
    effort: FloatArray,
    answers: FloatArray,
    noise_std: float,
) -> FloatArray:
    """Costs of responses with the measurement noise in them, shape (loops,).

    Where the share of the noise is not known from the weights of the error, it is the mean over
    one fixed sequence of noise and its negative, which leaves out the terms of odd order.

    Args:
        output: Shape (loops, samples).
        effort: The same.
        answers: Of measurement and effort to the noise, shape (loops, 2, samples); or variances
            by it, shape (loops, 2), as of `ClosedLoop.noise_gains`.
        noise_std: Of the measurement.
    """

    def cost(measurement: FloatArray, command: FloatArray) -> FloatArray:
        columns = trial.setpoint, measurement, command
        rate = trial.controller.sampling_Hz
        return np.asarray(trial.cost.evaluate(rate, trial.step, *columns))

    if noise_std == 0.0:
        return cost(output, effort)
    if answers.ndim == 2:
        after = trial.samples - trial.step.sample
        weights = np.array([trial.error_weight, trial.cost.move_weight * after])
        share = (noise_std / trial.step.size) ** 2 * (answers @ weights)
        return np.asarray(cost(output, effort) + share)
    y, u = answers[:, 0], answers[:, 1]
    return np.asarray(0.5 * (cost(output + y, effort + u) + cost(output - y, effort - u)))


@lru_cache(maxsize=16)
def fixed_noise(samples: int) -> FloatArray:
    """White noise of standard deviation one, the same at all gains."""
    return np.random.default_rng(0).standard_normal(samples)
