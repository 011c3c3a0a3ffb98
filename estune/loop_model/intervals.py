"""Predictions of an identified loop with their 95 % intervals."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.allowed_models import Draws, allowed_draws, plain_draws
from estune.loop_model.drawn_models import INFLATION
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import loop_response, robustness
from estune.loop_model.model import LoopModel
from estune.loop_model.prediction import Prediction, StepTrial, predict, predictions
from estune.loop_model.records import LoopRecord

MODEL_ERROR = 0.005
"""Error of Ms that always remains, relative to it, in trials from rest: on the 27 plants of
`experiments.batch` the estimate was off by at most 0.16 %, and every interval held without it."""

FRICTION_ERROR = 0.015
"""Error of Ms where friction or a bend was identified, relative to it: up to 1.2 % on the
reference reel with 0.005 to 0.05 N m, whose friction acts between the samples, and up to 0.8 % on
six loops of `experiments.loop_claims.mild` whose spring or sensor bends."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


class PredictedMargins(NamedTuple):
    """Predictions with intervals.

    Attributes:
        overshoot: As a share of the step.
        sensitivity: Ms.
        phase_margin_deg: Degrees.
    """

    cost: Interval
    overshoot: Interval
    sensitivity: Interval
    phase_margin_deg: Interval


def predict_with_intervals(
    fit: LoopFit,
    trial: StepTrial,
    gains: Gains,
    draws: Draws = (),
    model_error: float = MODEL_ERROR,
) -> PredictedMargins:
    """Predictions of an identified loop with 95 % intervals from drawn models.

    They are the wider of those by the white and by the between-record covariance, both inflated.
    What the records leave unexplained or do not excite is not in them (`plant_error`).

    Args:
        draws: The models; those that the covariances allow by default.
        model_error: Error of Ms that always remains, relative to it.
    """
    centre = _transformed(predict(fit.model, trial, gains, fit.noise_std))
    low, high = np.full(4, math.inf), np.full(4, -math.inf)
    for models in draws or plain_draws(fit):
        drawn = predictions(models, trial, [gains], fit.noise_std)
        ends = _ends(np.array([_transformed(one) for one in drawn]))
        low, high = np.fmin(low, ends[0]), np.fmax(high, ends[1])
    low, high = np.fmin(low, centre), np.fmax(high, centre)
    error = remaining_error(fit, model_error)
    if math.isfinite(centre[2]):  # an unstable loop has no Ms to widen
        low[2] = centre[2] - math.hypot(centre[2] - low[2], error)
        high[2] = centre[2] + math.hypot(high[2] - centre[2], error)
    cost, Ms = (tuple(np.exp([centre[i], low[i], high[i]]).tolist()) for i in (0, 2))
    return PredictedMargins(
        Interval(*cost),
        Interval(float(centre[1]), max(float(low[1]), 0.0), float(high[1])),
        Interval(*Ms),
        Interval(float(centre[3]), float(low[3]), float(high[3])),
    )


def relative_cost(
    fit: LoopFit, trial: StepTrial, gains: Gains, other: Gains, draws: Draws = ()
) -> Interval:
    """The cost of some gains over that of others by the same models, with its 95 % interval."""

    def ratios(models: Sequence[LoopModel]) -> FloatArray:
        costs = [
            np.array([one.cost for one in predictions(models, trial, [at], fit.noise_std)])
            for at in (gains, other)
        ]
        with np.errstate(invalid="ignore"):
            return np.asarray(costs[0] / costs[1])

    value = float(ratios([fit.model])[0])
    ends = np.array([_ends(ratios(models)[:, None]) for models in draws or plain_draws(fit)])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    return Interval(value, min(low, value), max(high, value))


def remaining_error(fit: LoopFit, model_error: float = MODEL_ERROR) -> float:
    """Error of ln Ms that no further record takes off."""
    straight = not fit.model.friction and fit.model.bend.is_straight
    of_loop = 0.0 if straight else FRICTION_ERROR
    return math.hypot(model_error, fit.near_error or of_loop)


def margins_by_records(
    fit: LoopFit, records: Sequence[LoopRecord], trial: StepTrial, gains: Gains
) -> PredictedMargins:
    """Predictions with intervals; where draws are unstable, by those that the records allow."""
    draws = plain_draws(fit)
    found = predict_with_intervals(fit, trial, gains, draws)
    if math.isfinite(found.sensitivity.high) or fit.model.friction:
        return found
    return predict_with_intervals(fit, trial, gains, allowed_draws(fit, records, draws))


def _ends(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ends of the central 95 % of drawn values, shape (draws, quantities); NaN is unstable."""
    count = len(values)
    tail = max(round(0.025 * count), 1)
    lowest = np.sort(np.where(np.isnan(values), -math.inf, values), axis=0)
    highest = np.sort(np.where(np.isnan(values), math.inf, values), axis=0)
    return lowest[tail - 1], highest[count - tail]


def setpoint_deviation(
    fit: LoopFit,
    records: Sequence[LoopRecord],
    gains: Gains,
    controller: ControllerSettings,
) -> float:
    """Standard deviation of ln Ms, inflated, counting only what the setpoint excites.

    The loop of the model answers the setpoint of each record without noise, and the slopes of
    that answer take the place of those of the record. Infinite where no setpoint moves.
    """
    answers = []
    for record in records:
        if record.gains is None or not np.ptp(record.setpoint):
            continue
        held = np.isfinite(record.limits).any()
        if not (held or math.isfinite(robustness(fit.model, record.gains, controller)[0])):
            return math.inf
        output, effort = setpoint_response(fit.model, record, record.gains, controller)
        if not (np.isfinite(output).all() and np.isfinite(effort).all()):
            return math.inf
        moves = record.setpoint - record.setpoint[0]
        answers.append(LoopRecord(effort, output, moves, record.gains, record.at_rest))
    if not answers:
        return math.inf
    model, signals = fit.model, fit.signals(answers)
    count = model.order + len(model.numerator)
    with np.errstate(over="ignore", invalid="ignore"):  # of an answer that hardly dies out
        slopes_of_all = fit.solution(signals).slopes(signals)
        columns = _deviations(slopes_of_all[:, :count], fit.residual_std)
    if columns is None:
        return math.inf
    theta, slopes = model.parameters, []
    for column in columns.T:
        # A step that changes Ms by little, for one as long as the deviation may be unstable.
        share = min(1.0, 1e-2 / max(float(np.abs(column[: model.order]).max()), 1e-300))
        moved = np.zeros(theta.size)
        moved[:count] = share * column
        ends = [
            math.log(peak_sensitivity(model.with_parameters(theta + s * moved), gains, controller))
            for s in (1.0, -1.0)
        ]
        slopes.append((ends[0] - ends[1]) / (2.0 * share))
    total = INFLATION * math.hypot(*slopes)
    return total if math.isfinite(total) else math.inf


def _deviations(slopes: FloatArray, error_std: float) -> FloatArray | None:
    """Independent steps of one standard deviation each, as columns; None where one is endless."""
    size = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    if not np.isfinite(size).all():  # poles that no record of this length resolves
        return None
    values, vectors = np.linalg.eigh((slopes / size).T @ (slopes / size))
    if not values[-1] > 0.0:
        return None
    # A short log may know nothing of a pole, or of the gain: rounding leaves zero or less of it,
    # whose root is no number.
    values = np.maximum(values, 1e-13 * values[-1])
    with np.errstate(over="ignore"):
        columns = error_std * (vectors / np.sqrt(values)) / size[:, np.newaxis]
    return columns if np.isfinite(columns).all() else None


def peak_sensitivity(model: LoopModel, gains: Gains, controller: ControllerSettings) -> float:
    """Largest |S| over frequency: Ms, or of an unstable loop how far it is from the margin."""
    Ms = robustness(model, gains, controller)[0]
    if math.isfinite(Ms):
        return Ms
    return float(np.max(1.0 / np.abs(1.0 + loop_response(model, gains, controller).loop)))


def _transformed(p: Prediction) -> FloatArray:
    return np.array([math.log(p.cost), p.overshoot, math.log(p.sensitivity), p.phase_margin_deg])
