"""One trial: the request, the record, and the rig that turns one into the other."""

from estune.trial.description import LinearModel, RigDescription, RigLimits
from estune.trial.records import (
    GUARD,
    LATE,
    OPTIONAL_COLUMNS,
    SATURATED,
    Outcome,
    Telemetry,
    TrialRecord,
    TrialRequest,
    empty_record,
)
from estune.trial.rig import CompensatedRig, Rig, TelemetrySource
from estune.trial.setpoints import SETPOINT_S, Feedback, Setpoint, SetpointFollower

__all__ = [
    "GUARD",
    "LATE",
    "OPTIONAL_COLUMNS",
    "SATURATED",
    "SETPOINT_S",
    "CompensatedRig",
    "Feedback",
    "LinearModel",
    "Outcome",
    "Rig",
    "RigDescription",
    "RigLimits",
    "Setpoint",
    "SetpointFollower",
    "Telemetry",
    "TelemetrySource",
    "TrialRecord",
    "TrialRequest",
    "empty_record",
]
