"""What the identified loop predicts of a trial, beside what the trial measured."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.loop_model.prediction import Prediction, StepTrial
from estune.loop_model.records import LoopRecord
from estune.tuners.search_space import Coordinates

NOISE_EXPECTED = 0.03
"""Relative standard deviation of the cost before enough predictions were compared."""

SMOOTHED = 5
"""Samples of the means by which a record's overshoot is measured: with 0.4 % noise of the step
its largest sample is 1 % too high, its largest mean 0.5 %."""


class ComparedTrial(NamedTuple):
    """A trial beside what was predicted of it.

    Attributes:
        x: Its coordinates.
        log_cost: Logarithm of its cost.
        overshoot: As a share of the step.
        error: Its log cost less the one predicted before it ran; NaN before the first fit.
    """

    x: Coordinates
    log_cost: float
    overshoot: float
    error: float


def difference(one: Prediction, other: Prediction) -> float:
    """Largest difference of two predictions, of cost and sensitivity by their logarithms."""
    if not (math.isfinite(one.cost) and math.isfinite(other.cost)):
        return math.inf
    return max(
        abs(math.log(one.cost / other.cost)),
        abs(math.log(one.sensitivity / other.sensitivity)),
        abs(one.overshoot - other.overshoot),
    )


def log_of_cost(prediction: Prediction) -> float:
    """The logarithm of the predicted cost."""
    return math.log(prediction.cost)


def measured_overshoot(record: LoopRecord, trial: StepTrial) -> float:
    """Overshoot of a record, as a share of the step, by means of `SMOOTHED` samples."""
    after = record.measurement[record.step_index : trial.end] - trial.preload
    smooth = np.convolve(after, np.full(SMOOTHED, 1.0 / SMOOTHED), mode="valid")
    return max(float(np.max(smooth / trial.step.size)) - 1.0, 0.0)


def cost_noise(trials: Sequence[ComparedTrial]) -> float:
    """Relative standard deviation of the cost, by the errors of the last predictions."""
    recent = [trial.error for trial in trials[-8:] if math.isfinite(trial.error)]
    return float(np.std(recent)) if len(recent) > 3 else NOISE_EXPECTED
