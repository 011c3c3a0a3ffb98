"""Extremum-seeking PIDF auto-tuning of motorised cable reels, by experiment.

The library in three calls::

    result = estune.tune("tcp/127.0.0.1:7447")  # or a plant, or a rig
    result = estune.resume("runs/20261121-120000")
    result = estune.load("runs/20261121-120000")

and over many lengths at once::

    result = estune.sweep("sweep.toml")

and from logs of a loop in service::

    suggestion = estune.suggest("logs", gains=estune.Gains(2.0, 0.5, 0.0, 0.0))
"""

from typing import TYPE_CHECKING

from estune.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from estune.api import load, resume, tune
    from estune.core.cost import StepCost
    from estune.core.gains import Gains
    from estune.core.pidf import ControllerSettings
    from estune.errors import EstuneError
    from estune.run.results.result import TuneResult
    from estune.service_records.suggestion import suggest
    from estune.studies.compare.comparison import compare
    from estune.studies.law.start import start_from
    from estune.studies.match.procedure import match
    from estune.studies.sweep.sweep import sweep
    from estune.support.version import __version__
    from estune.trial import TrialRequest
    from estune.trial.profiles import StepProfile
    from estune.tuners.search_space import SearchSpace

__all__ = [
    "ControllerSettings",
    "EstuneError",
    "Gains",
    "SearchSpace",
    "StepCost",
    "StepProfile",
    "TrialRequest",
    "TuneResult",
    "__version__",
    "compare",
    "load",
    "match",
    "resume",
    "start_from",
    "suggest",
    "sweep",
    "tune",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "estune.api": ("load", "resume", "tune"),
        "estune.core.cost": ("StepCost",),
        "estune.core.gains": ("Gains",),
        "estune.core.pidf": ("ControllerSettings",),
        "estune.errors": ("EstuneError",),
        "estune.run.results.result": ("TuneResult",),
        "estune.service_records.suggestion": ("suggest",),
        "estune.studies.compare.comparison": ("compare",),
        "estune.studies.law.start": ("start_from",),
        "estune.studies.match.procedure": ("match",),
        "estune.studies.sweep.sweep": ("sweep",),
        "estune.support.version": ("__version__",),
        "estune.trial": ("TrialRequest",),
        "estune.trial.profiles": ("StepProfile",),
        "estune.tuners.search_space": ("SearchSpace",),
    },
)
