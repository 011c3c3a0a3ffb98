"""Cost, constraint margin and step metrics of a trial record."""

import math

import numpy as np

from estune.core.cost import StepCost
from estune.core.metrics import (
    NO_METRICS,
    LoadMetrics,
    StepMetrics,
    load_metrics,
    step_metrics,
)
from estune.errors import RigError
from estune.trial.description import RigDescription
from estune.trial.profiles import StepProfile, load_step
from estune.trial.records import Outcome, TrialRecord


def cost_of(
    record: TrialRecord, step: StepProfile, cost: StepCost, newtons_per_ampere: float
) -> float:
    """The cost of one step trial: eta of (35), with its options.

    Returns:
        The cost; NaN unless the trial is done and its values are finite.

    Raises:
        InvalidInput: the settling time is longer than the record after the step.
        RigError: the trial is reported done with another number of samples than requested.
    """
    if not _is_complete(record, step):
        return math.nan
    eta = cost.evaluate(
        record.sampling_Hz,
        step.step_index(record.sampling_Hz),
        step.step_N,
        record.setpoint_N,
        record.tension_N,
        record.current_A * newtons_per_ampere,
        load=load_step(step, record.sampling_Hz),
    )
    return float(eta) if np.isfinite(eta) else math.nan


def constraint_margin(record: TrialRecord, rig: RigDescription) -> float:
    """Smallest constraint margin of a trial, relative to the distance of setpoint and limit.

    For the upper limits of tension and control effort the margin is

        (limit - greatest value) / (limit - greatest setpoint),

    likewise for the lower ones: 1 where the response stays within its setpoints, 0 at a limit. A
    limit at a setpoint is left out.

    Returns:
        The margin, below zero past a limit; infinite without a limit or a sample.
    """
    if not len(record.time_s):
        return math.inf
    effort_N = record.current_A * rig.newtons_per_ampere
    low, high = float(np.min(record.setpoint_N)), float(np.max(record.setpoint_N))
    limits, controller = rig.limits, rig.controller
    sides = (
        (limits.tension_max_N - high, limits.tension_max_N - np.max(record.tension_N)),
        (low - limits.tension_min_N, np.min(record.tension_N) - limits.tension_min_N),
        (controller.output_max_N - high, controller.output_max_N - np.max(effort_N)),
        (low - controller.output_min_N, np.min(effort_N) - controller.output_min_N),
    )
    margins = [float(left / room) for room, left in sides if 0.0 < room < math.inf]
    return min((margin for margin in margins if not math.isnan(margin)), default=math.inf)


def metrics_of(record: TrialRecord, step: StepProfile) -> StepMetrics:
    """Rise time, settling time, overshoot and steady-state error of a step trial.

    Returns:
        The metrics; all NaN unless the trial is done and its values are finite.

    Raises:
        RigError: as in `cost_of`.
    """
    if not _is_complete(record, step):
        return NO_METRICS
    load = load_step(step, record.sampling_Hz)
    tracked = slice(None, None if load is None else load.sample)
    return step_metrics(
        record.time_s[tracked],
        record.tension_N[tracked],
        step_time_s=float(record.time_s[step.step_index(record.sampling_Hz)]),
        initial=step.preload_N,
        final=step.preload_N + step.step_N,
    )


def load_metrics_of(record: TrialRecord, step: StepProfile) -> LoadMetrics | None:
    """Peak and recovery time after the load of a trial; None without a load.

    Raises:
        RigError: as in `cost_of`.
    """
    load = load_step(step, record.sampling_Hz)
    if load is None or not _is_complete(record, step):
        return None
    return load_metrics(
        record.time_s,
        record.tension_N,
        step=step.step_index(record.sampling_Hz),
        load=load.sample,
        initial=step.preload_N,
        final=step.preload_N + step.step_N,
    )


def _is_complete(record: TrialRecord, step: StepProfile) -> bool:
    """Whether the trial is done and its values are finite; raises if its length is wrong."""
    if record.outcome is not Outcome.DONE:
        return False
    expected = step.samples(record.sampling_Hz)
    for name in ("time_s", "setpoint_N", "tension_N", "current_A"):
        sent = len(getattr(record, name))
        if sent != expected:
            raise RigError(
                f"trial {record.trial_id} of rig {record.rig} is reported done with {sent} "
                f"samples of {name} instead of {expected}; check the rig's sampling rate"
            )
    columns = (record.setpoint_N, record.tension_N, record.current_A)
    return all(np.isfinite(column).all() for column in columns)
