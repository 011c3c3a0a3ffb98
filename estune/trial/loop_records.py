"""From a trial record to the signals that identify the loop.

The effort is recomputed from setpoint, measurement and gains by the controller's equation: a
logged effort that is one sample off moves the identified Ms by a fifth, and no residual shows it.
The logged effort only checks the recomputed one, and gives its unknown integral.
"""

from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import unlimited_effort
from estune.core.controller_form import ControllerForm
from estune.core.quantities import FloatArray
from estune.loop_model.records import LoopRecord
from estune.trial.description import RigDescription
from estune.trial.outcome import Outcome
from estune.trial.profiles import StepProfile
from estune.trial.records import SATURATED, TrialRecord

LAGS = (-2, -1, 0, 1, 2)
"""Shifts of the logged effort that are compared with none, in samples."""

GAIN_ERROR_MAX = 0.05
"""Allowed error of the gain from recomputed to logged effort."""

ALIKE = 0.9
"""Correlation of the increments of both from which shift and gain can be read."""


class LoopSignals(NamedTuple):
    """Signals of one trial for the identification, or why there are none.

    Attributes:
        record: The signals; None where they cannot be used.
        reason: Why not; empty otherwise.
    """

    record: LoopRecord | None
    reason: str = ""


def loop_signals(record: TrialRecord, step: StepProfile, rig: RigDescription) -> LoopSignals:
    """The signals of a step trial, or of an excitation, that identify the loop."""
    columns = (record.setpoint_N, record.tension_N, record.current_A)
    if record.outcome is not Outcome.DONE or not all(np.isfinite(c).all() for c in columns):
        return LoopSignals(None, "the trial did not end well")
    logged = record.controller_A * rig.newtons_per_ampere
    effort = logged
    # What is fed forward is part of the plant that the gains see.
    # Where the limits act, the effort does not follow from setpoint and measurement alone.
    if not (record.flags & SATURATED).any():
        effort = recomputed_effort(record, rig, float(logged[0]))
        reason = _mismatch(np.diff(effort), np.diff(logged))
        if reason:
            return LoopSignals(None, reason)
        # The first sample's level has its noise, which the derivative makes many times as large.
        effort = effort + float(np.median(logged - effort))
    if record.profile == step.kind:  # an excitation has no load
        effort = effort + step.shape(record.sampling_Hz).loads(effort.size)
    columns = effort, record.tension_N, record.setpoint_N
    return LoopSignals(LoopRecord(*columns, record.gains, at_rest=True))


def recomputed_effort(
    record: TrialRecord,
    rig: RigDescription,
    first_effort: float,
    form: ControllerForm | None = None,
) -> FloatArray:
    """The controller's effort for the record's setpoint and measurement, shape (samples,).

    Args:
        record: A trial in which no limit acted.
        rig: Gives the fixed part of the controller.
        form: Of the controller; the rig's own by default.
    """
    return unlimited_effort(
        rig.controller,
        record.gains,
        record.setpoint_N,
        record.tension_N,
        first_effort=first_effort,
        form=form,
    )


def _mismatch(recomputed: FloatArray, logged: FloatArray) -> str:
    """In what the increments of the logged effort differ from the recomputed; empty in nothing."""
    longest = max(LAGS)
    if recomputed.size <= 4 * longest or not logged.any():
        return "the logged effort stands still" if recomputed.any() else ""
    inner = slice(longest, recomputed.size - longest)
    base = recomputed[inner]
    gains, fits = [], []
    for lag in LAGS:
        shifted = logged[inner.start + lag : inner.stop + lag]
        gains.append(float(shifted @ base) / max(float(base @ base), 1e-300))
        scale = np.sqrt(float(base @ base) * float(shifted @ shifted))
        fits.append(float(shifted @ base) / max(float(scale), 1e-300))
    best = int(np.argmax(fits))
    if fits[best] < ALIKE:
        return (
            "the logged effort does not follow from setpoint, measurement and gains; check that "
            "the rig applies the gains of a trial"
        )
    if LAGS[best] != 0:
        late = "late" if LAGS[best] > 0 else "early"
        return f"the logged effort is {abs(LAGS[best])} sample(s) {late}"
    if abs(gains[best] - 1.0) > GAIN_ERROR_MAX:
        return (
            f"the logged effort is {gains[best]:.1f} times what the gains give; check that "
            "the rig applies the gains of a trial"
        )
    return ""
