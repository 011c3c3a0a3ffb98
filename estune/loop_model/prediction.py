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
from estune.loop_model.identification import LoopFit
from estune.loop_model.model import ClosedLoop, LoopModel, close_loop, robustness
from estune.loop_model.sampled_loop import sampled_response

INFLATION = 1.5
"""Factor on the wider of the two standard errors of the fit: with it intervals of Ms hold the
true value in 1.00 of 42 fits on seven families, without it in 0.83 to 0.95."""


GRID_ERROR = 2e-3
"""Error of Ms between the angles of the grid, against 200 000 angles, relative to it."""


MISFIT_ERROR = 20.0
"""Error of Ms per misfit, relative to it. Reels and loops outside the class whose misfit is below
0.5 % are off by 7 (five lags) to 35 times it (stiffening)."""

FRICTION_ERROR = 0.015
"""Error of Ms where friction was identified, relative to it: up to 1.2 % on the reference reel
with 0.005 to 0.05 N m, whose friction acts between the samples."""


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


def _response(
    model: LoopModel, loop: ClosedLoop, trial: StepTrial, gains: Gains
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations; by samples only with friction, or where limits act."""
    settings = trial.controller
    if not model.friction_N:
        output, effort = loop.step_response(trial.setpoint_N)
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


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


class PredictedMargins(NamedTuple):
    """Predictions with intervals.

    Attributes:
        cost: Expected cost.
        overshoot: As a share of the step.
        sensitivity: Ms.
        phase_margin_deg: Degrees.
    """

    cost: Interval
    overshoot: Interval
    sensitivity: Interval
    phase_margin_deg: Interval


def predict_with_intervals(fit: LoopFit, trial: StepTrial, gains: Gains) -> PredictedMargins:
    """Predictions of an identified loop with 95 % intervals by linear propagation of errors.

    Cost and Ms are propagated as logarithms. The standard error is the wider of the white and the
    between-record estimate, times `INFLATION`. An interval is NaN where the loop is unstable at
    both ends of an error: no slope is known there.
    """
    at = predict(fit.model, trial, gains, fit.noise_N)
    centre = _transformed(at)
    theta = fit.model.parameters
    white, clustered = (
        np.linalg.cholesky(_positive(cov)) for cov in (fit.covariance, fit.clustered)
    )
    widths = []
    for factor, quantile in ((white, 1.96), (clustered, fit.quantile)):
        moved = []
        for column in factor.T:
            ends = [
                _transformed(
                    predict(
                        fit.model.with_parameters(theta + s * column), trial, gains, fit.noise_N
                    )
                )
                for s in (0.5, -0.5)
            ]
            with np.errstate(invalid="ignore"):
                moved.append(ends[0] - ends[1])
        widths.append(quantile * np.sqrt(np.sum(np.square(moved), axis=0)))
    half = INFLATION * np.fmax(*widths)
    half[2] = math.hypot(half[2], MISFIT_ERROR * fit.misfit)
    half[2] = math.hypot(half[2], FRICTION_ERROR if fit.model.friction_N else GRID_ERROR)
    with np.errstate(invalid="ignore"):
        low, high = centre - half, centre + half
    return PredictedMargins(
        Interval(at.cost, float(np.exp(low[0])), float(np.exp(high[0]))),
        Interval(at.overshoot, max(float(low[1]), 0.0), float(high[1])),
        Interval(at.sensitivity, float(np.exp(low[2])), float(np.exp(high[2]))),
        Interval(at.phase_margin_deg, float(low[3]), float(high[3])),
    )


def parameter_deviations(fit: LoopFit) -> FloatArray:
    """A factor F of the inflated covariance F F' of the model's n parameters, shape (n, n)."""
    return np.asarray(INFLATION * np.linalg.cholesky(_positive(fit.covariance)))


def _transformed(p: Prediction) -> FloatArray:
    return np.array([math.log(p.cost), p.overshoot, math.log(p.sensitivity), p.phase_margin_deg])


def _positive(covariance: FloatArray) -> FloatArray:
    """A covariance with rounding errors removed, so that it has a Cholesky factor."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2.0)
    fixed = (vectors * np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(fixed * np.outer(scale, scale))
