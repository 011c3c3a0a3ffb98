"""What the first trial of a run shows of its rig: form, scale, and why it cannot be tuned."""

import math
from dataclasses import replace

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.run.plan import Plan
from estune.run.planning import step_trial
from estune.trial import Outcome, RigDescription, TrialRecord
from estune.trial.controller_fit import fitted_form
from estune.trial.effort_scale import measured_effort_scale
from estune.tuners.interface import RecordUsingTuner

ANSWERED = 5.0
"""Least change of the measurement over a trial, in standard errors of its means: noise alone
reaches 5 in one trial of a million."""

BACKWARDS = (
    "the measurement moved against the control effort from the step on: either the plant has the "
    "wrong sign (reverse the measurement or the drive), or it answers backwards at first and the "
    "gains are too large for that"
)

MEANS = 4
"""The last quarter of the samples after the step, before a load, is compared with those before it.
After a load the effort that meets it says nothing of the plant's sign: an integrating plant ends
where it was while the effort stays at the load with the sign changed."""


def adopted(plan: Plan, rig: RigDescription, record: TrialRecord) -> tuple[Plan, RigDescription]:
    """Plan and rig with what a first record shows and the rig does not declare.

    That is the form of its controller, and the measurement per effort by which the cost weighs
    the effort.
    """
    controller, cost, tuner = rig.controller, plan.cost, plan.tuner
    if controller.form is None and plan.needs_records:
        form = fitted_form(record, rig)
        rig = rig if form is None else replace(rig, controller=replace(controller, form=form))
    if cost.unscaled and record.outcome is Outcome.DONE:
        scale = measured_effort_scale(
            record, plan.step, rig.newtons_per_ampere, cost.settling_time_s
        )
        cost = cost.scaled(scale)
    if rig.controller == controller and cost == plan.cost:
        return plan, rig
    if isinstance(tuner, RecordUsingTuner):
        tuner = tuner.for_trial(step_trial(rig, plan.step, cost), plan.limits)
    return replace(plan, tuner=tuner, cost=cost), rig


def check_answer(record: TrialRecord, plan: Plan, rig: RigDescription) -> None:
    """Refuses a rig whose measurement does not follow its effort, or follows it the wrong way.

    Raises:
        InvalidInput: the measurement does not answer the effort of the first trial, answers with
            the wrong sign, or the effort stays at its limit.
    """
    index = plan.step.step_index(record.sampling_Hz)
    load = plan.step.shape(record.sampling_Hz).load
    before_load = slice(None if load is None else load.sample)
    effort = record.current_A[before_load] * rig.newtons_per_ampere
    measurement = record.tension_N[before_load]
    # Too few samples on one side for a mean and its error: no rig is refused for that.
    if not 1 < index < effort.size - MEANS:
        return
    moved, moved_error = _change(effort, index)
    answer, error = _change(measurement, index)
    # An effort that ends where it began asks nothing of the plant: no answer is no fault then.
    if not abs(moved) > ANSWERED * moved_error:
        return
    what = f"trial {record.trial_id}: the {rig.measurement_name}"
    moves = f"while the {rig.command_name} changes by {rig.commanded(moved)}"
    rounding = 1e-12 * float(np.abs(measurement).max())
    if abs(answer) <= max(ANSWERED * error, rounding):
        raise InvalidInput(
            f"{what} does not answer: it changes by {rig.measured(answer, 2)} {moves}; check the "
            "sensor and the drive, make the trial longer, or force the run (--force)"
        )
    if answer * plan.step.step_N < 0.0 and moved * plan.step.step_N > 0.0:
        raise InvalidInput(
            f"{what} changes by {rig.measured(answer, 2)} {moves}: the plant has the wrong sign, "
            "and no positive gains can control it; reverse the measurement or the drive, or force "
            "the run (--force)"
        )
    controller, tail = rig.controller, effort[-max(effort[index:].size // 10, 1) :]
    at_limit = (tail <= controller.output_min_N) | (tail >= controller.output_max_N)
    if at_limit.all():
        raise InvalidInput(
            f"trial {record.trial_id} ends with the {rig.command_name} at its limit of "
            f"{rig.commanded(float(tail[-1]))}: the step is too large for the drive; choose a "
            "smaller one, or force the run (--force)"
        )


def moved_backwards(record: TrialRecord, plan: Plan, rig: RigDescription) -> bool:
    """Whether the measurement of a trial that was cut short only moved against its effort.

    A plant of the wrong sign does so, and one that first answers backwards if the gains are too
    large for it. An oscillation that grows goes beyond its rest to both sides.
    """
    index, direction = (
        plan.step.step_index(record.sampling_Hz),
        math.copysign(1.0, plan.step.step_N),
    )
    if not 1 < index < record.tension_N.size - 1:
        return False
    effort = direction * record.current_A * rig.newtons_per_ampere
    measured = direction * record.tension_N
    rest = float(measured[:index].mean())
    noise = ANSWERED * float(measured[:index].std())
    ahead, behind = measured[index:].max() - rest, rest - measured[-1]
    return bool(ahead <= noise < behind and effort[-1] > effort[:index].max())


def _change(values: FloatArray, index: int) -> tuple[float, float]:
    """Mean of a trial's end less that before its step, and the standard error by its noise."""
    before, after = values[:index], values[-max((values.size - index) // MEANS, 1) :]
    noise = float(np.std(np.diff(values))) / math.sqrt(2.0)
    error = noise * math.sqrt(1.0 / before.size + 1.0 / after.size)
    return float(after.mean() - before.mean()), error
