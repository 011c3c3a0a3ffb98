"""The peak of a step response, as trials of the same gains show it beside the model.

The mean difference of the measurement from the predicted response over the upper half of the
predicted peak is free of the model's error there, and has less noise than any largest value.
"""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.intervals import Interval
from estune.loop_model.loop_fit import NORMAL_QUANTILE, LoopFit
from estune.loop_model.model import close_loop
from estune.loop_model.prediction import StepTrial, expected_response
from estune.loop_model.records import LoopRecord


def shown_overshoot(
    fit: LoopFit, records: Sequence[LoopRecord], trial: StepTrial, gains: Gains, told: Interval
) -> Interval:
    """The interval of an overshoot, as a share of the step, with what the trials show of it.

    Args:
        fit: The identified loop, stable with the gains.
        records: The records given to the fit.
        told: The interval by the model.
    """
    response = expected_response(fit.model, trial, gains)
    window = _upper_half(response, trial)
    own = [
        record.measurement - record.setpoint[0]
        for record in fit.fitted(records)
        if record.at_rest
        and record.gains == gains
        and record.samples == trial.samples
        and record.step_index == trial.step.sample
    ]
    if fit.strengths or not (own and window.any()):  # trials of another gain show another peak
        return told
    differences = [float(np.mean((one - response)[window])) / trial.step.size for one in own]
    mean = told.value + float(np.mean(differences))
    half = NORMAL_QUANTILE * peak_deviation(fit, trial, gains) / math.sqrt(len(own))
    return told._replace(
        low=max(min(told.low, mean - half), 0.0), high=max(told.high, mean + half)
    )


def peak_deviation(fit: LoopFit, trial: StepTrial, gains: Gains) -> float:
    """Standard deviation of what one trial shows of a peak, as a share of the step, by its noise.

    Zero where the predicted response has no peak above the setpoint.
    """
    window = _upper_half(expected_response(fit.model, trial, gains), trial)
    return _deviation(fit, trial, gains, window[::-1] / max(int(np.count_nonzero(window)), 1))


def load_deviation(fit: LoopFit, trial: StepTrial, gains: Gains) -> float:
    """Standard deviation of a measurement by load, drift and noise, as a share of the step.

    Zero where the fit knows of no load or drift.
    """
    return _deviation(fit, trial, gains, np.eye(1, trial.samples)[0]) if fit.is_loaded else 0.0


def _deviation(fit: LoopFit, trial: StepTrial, gains: Gains, weights: FloatArray) -> float:
    """Standard deviation of a weighted sum of a measurement, its weights run backwards."""
    before = 0 if fit.noise.is_white else trial.samples  # a load acts before the trial, too
    answer = fit.disturbance(np.concatenate([weights, np.zeros(before)]))
    found = close_loop(fit.model, gains, trial.controller).noise_response(answer)[0]
    return fit.error_std * float(np.linalg.norm(found)) / abs(trial.step.size)


def _upper_half(response: FloatArray, trial: StepTrial) -> FloatArray:
    """Where a response is in the upper half of its peak above the setpoint, shape (samples,)."""
    beyond = response / trial.step.size - 1.0
    beyond[: trial.step.sample], beyond[trial.end :] = -1.0, -1.0
    at = int(np.argmax(beyond))
    inside = beyond > 0.5 * max(float(beyond[at]), 0.0)
    out = np.flatnonzero(~inside)
    low, high = out[out < at].max(initial=-1), out[out > at].min(initial=inside.size)
    window = np.zeros(inside.size, dtype=bool)
    window[low + 1 : high] = inside[at]
    return window
