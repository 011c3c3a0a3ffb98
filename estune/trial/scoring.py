"""Cost, constraint margin and step metrics of a trial record."""

import math
from itertools import pairwise

import numpy as np

from estune.core.cost import StepCost
from estune.core.metrics import (
    NO_METRICS,
    LoadMetrics,
    StepMetrics,
    load_metrics,
    step_metrics,
)
from estune.core.oscillation import growing_oscillation
from estune.core.quantities import FloatArray
from estune.errors import RigError
from estune.trial.description import RigDescription
from estune.trial.effort_scale import measured_effort_scale
from estune.trial.outcome import Outcome
from estune.trial.profiles import StepProfile
from estune.trial.records import TrialRecord


def cost_of(
    record: TrialRecord, step: StepProfile, cost: StepCost, newtons_per_ampere: float
) -> float:
    """The cost of one step trial: eta of (35), with its options.

    Returns:
        The cost; NaN unless the trial is done, its values are finite and no oscillation grows.

    Raises:
        InvalidInput: the settling time is longer than the record after the step.
        RigError: the trial is reported done with another number of samples than requested.
    """
    if not _is_complete(record, step) or growing_oscillation_Hz(record, step) is not None:
        return math.nan
    if cost.unscaled:
        cost = cost.scaled(
            measured_effort_scale(record, step, newtons_per_ampere, cost.settling_time_s)
        )
    eta = cost.evaluate(
        record.sampling_Hz,
        step.shape(record.sampling_Hz),
        record.setpoint_N,
        record.tension_N,
        record.current_A * newtons_per_ampere,
    )
    return float(eta) if np.isfinite(eta) else math.nan


def growing_oscillation_Hz(record: TrialRecord, step: StepProfile) -> float | None:
    """Frequency of an oscillation that grows after the step or after the load; None without one.

    In a longer trial it would grow further, so that no cost of the trial says what the gains cost.
    """
    shape = step.shape(record.sampling_Hz)
    begins = [shape.sample + shape.ramp - 1, *([shape.load.sample] if shape.load else [])]
    for first, end in pairwise([*begins, record.tension_N.size]):
        frequency = growing_oscillation(record.tension_N[first:end])
        if frequency is not None:
            return frequency * record.sampling_Hz
    return None


def unscored(record: TrialRecord, step: StepProfile) -> str:
    """Why a trial that was done has no cost; empty where nothing is known."""
    if not _is_complete(record, step):
        return ""
    frequency_Hz = growing_oscillation_Hz(record, step)
    if frequency_Hz is None:
        return ""
    return f"its response oscillates at {frequency_Hz:.3g} Hz with a growing amplitude"


def constraint_margin(record: TrialRecord, rig: RigDescription) -> float:
    """Smallest constraint margin of a trial, relative to the distance of reference and limit.

    For the upper limits of measurement and control effort the margin is

        (limit - greatest value) / (limit - greatest reference),

    likewise for the lower ones: 1 where the response stays within its references, 0 at a limit. A
    limit at a reference is left out. The reference of the measurement is its setpoint; that of the
    effort as well where both have one unit, for a reel at rest is driven with the tension it
    holds; otherwise it is the effort that holds the plant before the step and at the end.

    Returns:
        The margin, below zero past a limit; infinite without a limit or a sample.
    """
    if not len(record.time_s):
        return math.inf
    effort = record.current_A * rig.newtons_per_ampere
    setpoint = record.setpoint_N
    limits, controller = rig.limits, rig.controller
    held = setpoint if rig.have_one_unit else _holding(setpoint, effort)
    margins = [
        *_room(setpoint, record.tension_N, limits.tension_min_N, limits.tension_max_N),
        *_room(held, effort, controller.output_min_N, controller.output_max_N),
    ]
    return min((margin for margin in margins if not math.isnan(margin)), default=math.inf)


def _room(reference: FloatArray, values: FloatArray, low: float, high: float) -> list[float]:
    """Margins of values to two limits, relative to that of their reference."""
    sides = (
        (high - np.max(reference), high - np.max(values)),
        (np.min(reference) - low, np.min(values) - low),
    )
    return [float(left / room) for room, left in sides if 0.0 < room < math.inf]


def _holding(setpoint: FloatArray, effort: FloatArray) -> FloatArray:
    """Mean efforts at the end of the first and of the last setpoint, over a tenth of each."""
    changes = np.flatnonzero(np.diff(setpoint)) + 1
    stretches = np.split(effort, changes[[0, -1]]) if changes.size else [effort]
    ends = (stretches[0], stretches[-1])
    return np.array([np.mean(stretch[-max(1, stretch.size // 10) :]) for stretch in ends])


def metrics_of(record: TrialRecord, step: StepProfile) -> StepMetrics:
    """Rise time, settling time, overshoot and steady-state error of a step trial.

    Returns:
        The metrics; all NaN unless the trial is done and its values are finite.

    Raises:
        RigError: as in `cost_of`.
    """
    if not _is_complete(record, step):
        return NO_METRICS
    load = step.shape(record.sampling_Hz).load
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
    load = step.shape(record.sampling_Hz).load
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
