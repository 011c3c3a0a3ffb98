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
        "estune.trial.description": ("LinearModel", "RigDescription", "RigLimits"),
        "estune.trial.outcome": ("Outcome",),
        "estune.trial.records": (
            "GUARD",
            "LATE",
            "OPTIONAL_COLUMNS",
            "SATURATED",
            "Telemetry",
            "TrialRecord",
            "TrialRequest",
            "empty_record",
        ),
        "estune.trial.rig": ("CompensatedRig", "Rig", "TelemetrySource"),
        "estune.trial.setpoints": ("Feedback", "SETPOINT_S", "Setpoint", "SetpointFollower"),
    },
)
