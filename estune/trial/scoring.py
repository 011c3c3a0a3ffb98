"""From a trial record to its cost and to the numbers beside it."""

import math

import numpy as np

from estune.core.cost import StepCost
from estune.core.metrics import NO_METRICS, StepMetrics, step_metrics
from estune.errors import RigError
from estune.trial.description import RigDescription
from estune.trial.profiles import StepProfile
from estune.trial.records import Outcome, TrialRecord


def cost_of(
    record: TrialRecord, step: StepProfile, cost: StepCost, newtons_per_ampere: float
) -> float:
    """The cost of one step trial: eta of (35), with its options.

    Args:
        record: What the rig measured.
        step: The step that was asked for.
        cost: The settings of (35).
        newtons_per_ampere: Tension at rest per motor current, N/A: turns current into effort.

    Returns:
        The cost; NaN if the trial did not end well or holds values that are not finite.

    Raises:
        InvalidInput: the settling time is longer than what was recorded after the step.
        RigError: the rig says the trial ran to its end, but sent another number of samples than
            were asked for.
    """
    if not _is_whole(record, step):
        return math.nan
    eta = cost.evaluate(
        record.sampling_Hz,
        step.step_index(record.sampling_Hz),
        step.step_N,
        record.setpoint_N,
        record.tension_N,
        record.current_A * newtons_per_ampere,
    )
    return float(eta) if np.isfinite(eta) else math.nan


def constraint_margin(record: TrialRecord, rig: RigDescription) -> float:
    """How near a trial came to a limit of the rig: the smallest share left of any of its room.

    The room is what lies between the setpoint, at its highest or lowest, and a limit on the
    tension, or on the effort that holds the setpoint,

        (limit - greatest value) / (limit - greatest setpoint)

    and so on downwards: 1 where the response stays within its setpoints, 0 at a limit. A setpoint
    at a limit leaves no room to have a share of, and that side is left out.

    Args:
        record: What the rig measured.
        rig: Its limits, and those of its controller.

    Returns:
        The share, below zero past a limit; infinite without a limit or a sample.
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
    shares = [float(left / room) for room, left in sides if 0.0 < room < math.inf]
    return min((share for share in shares if not math.isnan(share)), default=math.inf)


def metrics_of(record: TrialRecord, step: StepProfile) -> StepMetrics:
    """Rise, settling, overshoot and steady-state error between the two levels of the setpoint.

    Args:
        record: What the rig measured.
        step: The step that was asked for.

    Returns:
        The metrics, all NaN if the trial did not end well or holds values that are not finite.

    Raises:
        RigError: as in `cost_of`.
    """
    if not _is_whole(record, step):
        return NO_METRICS
    return step_metrics(
        record.time_s,
        record.tension_N,
        step_time_s=float(record.time_s[step.step_index(record.sampling_Hz)]),
        initial=step.preload_N,
        final=step.preload_N + step.step_N,
    )


def _is_whole(record: TrialRecord, step: StepProfile) -> bool:
    """Whether the trial ran to its end and every value that is looked at is finite."""
    if record.outcome is not Outcome.DONE:
        return False
    _check_length(record, step)
    columns = (record.setpoint_N, record.tension_N, record.current_A)
    return all(np.isfinite(column).all() for column in columns)


def _check_length(record: TrialRecord, step: StepProfile) -> None:
    asked = step.samples(record.sampling_Hz)
    for name in ("time_s", "setpoint_N", "tension_N", "current_A"):
        sent = len(getattr(record, name))
        if sent != asked:
            raise RigError(
                f"trial {record.trial_id} of rig {record.rig} is reported done with {sent} "
                f"samples of {name} where {asked} were asked for; check the rig's sampling rate"
            )
