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
    from estune.core.search_space import SearchSpace
    from estune.errors import EstuneError
    from estune.joint.procedure import tune_schedule
    from estune.matching.procedure import match
    from estune.profiles import StepProfile
    from estune.result import TuneResult
    from estune.sweeping.sweep import sweep

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
    "SearchSpace": "estune.core.search_space",
    "StepCost": "estune.core.cost",
    "StepProfile": "estune.profiles",
    "TuneResult": "estune.result",
    "load": "estune.api",
    "match": "estune.matching.procedure",
    "resume": "estune.api",
    "sweep": "estune.sweeping.sweep",
    "tune": "estune.api",
    "tune_schedule": "estune.joint.procedure",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used, so that the command line starts quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
