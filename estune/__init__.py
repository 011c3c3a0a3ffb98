"""Extremum-seeking PIDF auto-tuning of motorised cable reels, by experiment.

The library in three calls:

    result = estune.tune("tcp/127.0.0.1:7447")   # or a plant, or a rig
    result = estune.resume("runs/20261121-120000")
    result = estune.load("runs/20261121-120000")

and over many lengths at once:

    result = estune.sweep("sweep.toml")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estune.api import load, resume, tune
    from estune.core.cost import StepCost
    from estune.core.gains import Gains
    from estune.core.pidf import ControllerSettings
    from estune.errors import EstuneError
    from estune.run.result import TuneResult
    from estune.studies.joint.procedure import tune_schedule
    from estune.studies.match.procedure import match
    from estune.studies.sweep.sweep import sweep
    from estune.trial.profiles import StepProfile
    from estune.tuners.search_space import SearchSpace

__all__ = [
    "ControllerSettings",
    "EstuneError",
    "Gains",
    "SearchSpace",
    "StepCost",
    "StepProfile",
    "TuneResult",
    "load",
    "match",
    "resume",
    "sweep",
    "tune",
    "tune_schedule",
]

_HOMES = {
    "ControllerSettings": "estune.core.pidf",
    "EstuneError": "estune.errors",
    "Gains": "estune.core.gains",
    "SearchSpace": "estune.tuners.search_space",
    "StepCost": "estune.core.cost",
    "StepProfile": "estune.trial.profiles",
    "TuneResult": "estune.run.result",
    "load": "estune.api",
    "match": "estune.studies.match.procedure",
    "resume": "estune.api",
    "sweep": "estune.studies.sweep.sweep",
    "tune": "estune.api",
    "tune_schedule": "estune.studies.joint.procedure",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used, so that the command line starts quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
