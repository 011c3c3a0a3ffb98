"""One trial: the request, the record, and the rig that turns one into the other."""

from typing import TYPE_CHECKING

from estune.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from estune.trial.description import LinearModel, RigDescription, RigLimits
    from estune.trial.outcome import Outcome
    from estune.trial.records import (
        GUARD,
        LATE,
        OPTIONAL_COLUMNS,
        SATURATED,
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

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "CompensatedRig": "estune.trial.rig",
        "Feedback": "estune.trial.setpoints",
        "GUARD": "estune.trial.records",
        "LATE": "estune.trial.records",
        "LinearModel": "estune.trial.description",
        "OPTIONAL_COLUMNS": "estune.trial.records",
        "Outcome": "estune.trial.outcome",
        "Rig": "estune.trial.rig",
        "RigDescription": "estune.trial.description",
        "RigLimits": "estune.trial.description",
        "SATURATED": "estune.trial.records",
        "SETPOINT_S": "estune.trial.setpoints",
        "Setpoint": "estune.trial.setpoints",
        "SetpointFollower": "estune.trial.setpoints",
        "Telemetry": "estune.trial.records",
        "TelemetrySource": "estune.trial.rig",
        "TrialRecord": "estune.trial.records",
        "TrialRequest": "estune.trial.records",
        "empty_record": "estune.trial.records",
    },
)
