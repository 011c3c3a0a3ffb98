"""Whether a record can be what was asked for, looked at before anything is concluded from it."""

from datetime import datetime

import numpy as np

from estune.trial.description import RigDescription
from estune.trial.records import Outcome, TrialRecord, TrialRequest

STEP_MAX = 10.0
"""Sampling periods from one sample to the next beyond which the rig's clock has jumped."""

_COLUMNS = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")


def record_fault(record: TrialRecord, request: TrialRequest, rig: RigDescription) -> str:
    """What is wrong with a record, in words; empty if nothing is.

    Only what a sound rig cannot send is a fault. A trial that went badly is none.

    Args:
        record: What the rig sent.
        request: What it was asked for.
        rig: What it said of itself.
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
    return _began(record) or _length(record, request) or _values(record) or _clock(record)


def _began(record: TrialRecord) -> str:
    try:
        began = datetime.fromisoformat(record.started_at)
    except ValueError:
        return f"its time of day {record.started_at!r:.40} is none"
    return "" if began.tzinfo else f"its time of day {record.started_at} has no offset from UTC"


def _length(record: TrialRecord, request: TrialRequest) -> str:
    lengths = {name: len(getattr(record, name)) for name in _COLUMNS}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        return f"its columns differ in length: {told}"
    asked, sent = request.profile.samples(record.sampling_Hz), lengths["time_s"]
    if record.outcome is Outcome.DONE and sent != asked:
        return f"it is said to be whole, with {sent} samples where {asked} were asked for"
    return f"it has {sent} samples where {asked} were asked for" if sent > asked else ""


def _values(record: TrialRecord) -> str:
    if record.outcome is not Outcome.DONE:  # a response may well leave the finite range
        return ""
    for name in _COLUMNS[:-1]:
        finite = np.isfinite(getattr(record, name))
        if not finite.all():
            at = int(np.argmin(finite))
            return f"{name} is {getattr(record, name)[at]} at sample {at}"
    return ""


def _clock(record: TrialRecord) -> str:
    steps = np.diff(record.time_s) * record.sampling_Hz
    bad = ~((steps > 0.0) & (steps < STEP_MAX))
    if not bad.any():
        return ""
    at = int(np.argmax(bad))
    return (
        f"its clock jumps: from {record.time_s[at]:.6g} s to {record.time_s[at + 1]:.6g} s "
        f"at sample {at + 1}"
    )
