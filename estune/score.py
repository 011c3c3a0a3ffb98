"""From a trial record to its cost and the numbers beside it."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.cost import StepCost
from estune.core.metrics import NO_METRICS, StepMetrics, step_metrics
from estune.errors import RigError
from estune.trial import Outcome, StepProfile, TrialRecord


class Score(NamedTuple):
    """How good a trial was.

    Attributes:
        cost: eta of (35), with its options; NaN unless the trial ran to its end and every value in
            it is finite.
        metrics: Rise time, settling time, overshoot and steady-state error; NaN with the cost.
    """

    cost: float
    metrics: StepMetrics


UNSCORED = Score(math.nan, NO_METRICS)


def score(
    record: TrialRecord, step: StepProfile, cost: StepCost, newtons_per_ampere: float
) -> Score:
    """The cost and the metrics of one step trial, measured between the two levels of the setpoint.

    Args:
        record: What the rig measured.
        step: The step that was asked for.
        cost: The settings of (35).
        newtons_per_ampere: Tension at rest per motor current, N/A: turns current into effort.

    Returns:
        The score, without a number in it if the trial did not end well or holds values that are
        not finite.

    Raises:
        InvalidInput: the settling time is longer than what was recorded after the step.
        RigError: the rig says the trial ran to its end, but sent another number of samples than
            were asked for.
    """
    if record.outcome is not Outcome.DONE:
        return UNSCORED
    columns = (record.setpoint_N, record.tension_N, record.current_A)
    _check_length(record, step)
    if not all(np.isfinite(column).all() for column in columns):
        return UNSCORED
    index = step.step_index(record.sampling_Hz)
    eta = cost.evaluate(
        record.sampling_Hz,
        index,
        step.step_N,
        record.setpoint_N,
        record.tension_N,
        record.current_A * newtons_per_ampere,
    )
    if not np.isfinite(eta):
        return UNSCORED
    metrics = step_metrics(
        record.time_s,
        record.tension_N,
        step_time_s=float(record.time_s[index]),
        initial=step.preload_N,
        final=step.preload_N + step.step_N,
    )
    return Score(float(eta), metrics)


def _check_length(record: TrialRecord, step: StepProfile) -> None:
    asked = step.samples(record.sampling_Hz)
    for name in ("time_s", "setpoint_N", "tension_N", "current_A"):
        sent = len(getattr(record, name))
        if sent != asked:
            raise RigError(
                f"trial {record.trial_id} of rig {record.rig} is reported done with {sent} "
                f"samples of {name} where {asked} were asked for; check the rig's sampling rate"
            )
