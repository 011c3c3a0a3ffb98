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
from estune.trial.rig import Rig, TelemetrySource

__all__ = [
    "GUARD",
    "LATE",
    "OPTIONAL_COLUMNS",
    "SATURATED",
    "LinearModel",
    "Outcome",
    "Rig",
    "RigDescription",
    "RigLimits",
    "Telemetry",
    "TelemetrySource",
    "TrialRecord",
    "TrialRequest",
    "empty_record",
]
