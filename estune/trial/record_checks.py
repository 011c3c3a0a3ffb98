"""Validation of a record against its request, before the record is used."""

from datetime import datetime

import numpy as np

from estune.trial.description import RigDescription
from estune.trial.outcome import Outcome
from estune.trial.records import COLUMNS, TrialRecord, TrialRequest

STEP_MAX = 10.0
"""Sampling interval, in periods, from which the rig's clock has jumped."""


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
    if record.gains != request.gains:
        return f"it was run with {record.gains}, not with {request.gains}"
    if record.sampling_Hz != rig.controller.sampling_Hz:
        return (
            f"it was sampled at {record.sampling_Hz:g} Hz, the rig at "
            f"{rig.controller.sampling_Hz:g} Hz"
        )
    return (
        _start_fault(record)
        or _length_fault(record, request)
        or _value_fault(record)
        or _clock_fault(record)
    )


def _start_fault(record: TrialRecord) -> str:
    try:
        started = datetime.fromisoformat(record.started_at)
    except ValueError:
        return f"its time of day {record.started_at!r:.40} is not in ISO 8601"
    return "" if started.tzinfo else f"its time of day {record.started_at} has no offset from UTC"


def _length_fault(record: TrialRecord, request: TrialRequest) -> str:
    names = (*COLUMNS, "flags", *record.optional_columns)
    lengths = {name: len(getattr(record, name)) for name in names}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        return f"its columns differ in length: {listed}"
    expected, sent = request.profile.samples(record.sampling_Hz), lengths["time_s"]
    if record.outcome is Outcome.DONE and sent != expected:
        return f"it is reported done with {sent} samples instead of {expected}"
    return f"it has {sent} samples instead of {expected}" if sent > expected else ""


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
