"""Validation of a record against its request, before the record is used."""

from datetime import datetime

import numpy as np

from estune.trial.description import RigDescription
from estune.trial.outcome import Outcome
from estune.trial.records import COLUMNS, TrialRecord, TrialRequest

STEP_MAX = 10.0
"""Sampling interval, in periods, from which the rig's clock has jumped."""

SETPOINT_ERROR, ROUNDING = 0.01, 1e-3
"""Error of a setpoint that is allowed, as a share of the profile's range; that range is at least a
thousandth of the profile's greatest value, for a board may compute in single precision."""

EFFORT_ERROR = 0.01
"""What an effort may lie beyond its limits, as a share of their range: it may be rounded."""


def record_fault(record: TrialRecord, request: TrialRequest, rig: RigDescription) -> str:
    """The fault of a record in words; empty for a valid one.

    A fault is what a sound rig cannot send; a failed trial is none.
    """
    if record.trial_id != request.trial_id:
        return f"it is a stale one, of trial {record.trial_id}"
    if record.rig != rig.name:
        return f"it is from another rig, {record.rig!r}"
    if record.outcome.is_void:
        return ""
    return (
        _start_fault(record)
        or _length_fault(record)
        or request_fault(record, request, rig)
        or _value_fault(record)
        or _clock_fault(record)
    )


def request_fault(record: TrialRecord, request: TrialRequest, rig: RigDescription) -> str:
    """The first difference of what a rig ran from what was asked for; empty without one.

    Gains, sampling rate, number of samples, setpoint and limits of the effort are compared.
    """
    if record.gains != request.gains:
        return f"it was run with {record.gains}, not with {request.gains}"
    if record.sampling_Hz != rig.controller.sampling_Hz:
        return (
            f"it was sampled at {record.sampling_Hz:g} Hz, the rig at "
            f"{rig.controller.sampling_Hz:g} Hz"
        )
    expected, sent = request.profile.samples(record.sampling_Hz), len(record.time_s)
    if record.outcome is Outcome.DONE and sent != expected:
        return f"it is reported done with {sent} samples instead of {expected}"
    if sent > expected:
        return f"it has {sent} samples instead of {expected}"
    return _setpoint_fault(record, request, rig) or _effort_fault(record, rig)


def _setpoint_fault(record: TrialRecord, request: TrialRequest, rig: RigDescription) -> str:
    """The first sample whose setpoint is not that of the profile, nor of a sample beside it."""
    asked = request.profile.setpoint(record.sampling_Hz)
    beside = np.pad(asked, 1, mode="edge")
    around = np.stack([beside[:-2], asked, beside[2:]])[:, : len(record.setpoint_N)]
    rounding = ROUNDING * float(np.abs(asked).max())
    allowed = SETPOINT_ERROR * max(float(np.ptp(asked)), rounding)
    low, high = around.min(axis=0) - allowed, around.max(axis=0) + allowed
    inside = (record.setpoint_N >= low) & (record.setpoint_N <= high)
    if inside.all():
        return ""
    at = int(np.argmin(inside))
    ran, wanted = rig.measured(record.setpoint_N[at]), rig.measured(asked[at])
    return (
        f"its setpoint at sample {at} is {ran} where the {request.profile.kind} asked for has "
        f"{wanted}"
    )


def _effort_fault(record: TrialRecord, rig: RigDescription) -> str:
    """The first sample whose effort is beyond the limits that the rig declares."""
    effort, about = record.current_A * rig.newtons_per_ampere, rig.controller
    low, high = about.output_min_N, about.output_max_N
    allowed = EFFORT_ERROR * (high - low)
    beyond = (effort < low - allowed) | (effort > high + allowed)
    if not beyond.any():
        return ""
    at = int(np.argmax(beyond))
    return (
        f"its {rig.command_name} at sample {at} is {rig.commanded(float(effort[at]))}, beyond the "
        f"limits of {rig.commanded(low)} to {rig.commanded(high)} that the rig declares"
    )


def _start_fault(record: TrialRecord) -> str:
    try:
        started = datetime.fromisoformat(record.started_at)
    except ValueError:
        return f"its time of day {record.started_at!r:.40} is not in ISO 8601"
    return "" if started.tzinfo else f"its time of day {record.started_at} has no offset from UTC"


def _length_fault(record: TrialRecord) -> str:
    names = (*COLUMNS, "flags", *record.optional_columns)
    lengths = {name: len(getattr(record, name)) for name in names}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        return f"its columns differ in length: {listed}"
    return ""


def _value_fault(record: TrialRecord) -> str:
    if record.outcome is not Outcome.DONE:  # a diverged response may leave the finite range
        return ""
    for name in COLUMNS:
        finite = np.isfinite(getattr(record, name))
        if not finite.all():
            at = int(np.argmin(finite))
            return f"{name} is {getattr(record, name)[at]} at sample {at}"
    return ""


def _clock_fault(record: TrialRecord) -> str:
    steps = np.diff(record.time_s) * record.sampling_Hz
    jumps = ~((steps > 0.0) & (steps < STEP_MAX))
    if not jumps.any():
        return ""
    at = int(np.argmax(jumps))
    return (
        f"its clock jumps: from {record.time_s[at]:.6g} s to {record.time_s[at + 1]:.6g} s "
        f"at sample {at + 1}"
    )
