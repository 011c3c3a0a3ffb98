"""Tuners: each proposes the gains of the next trial from the costs of the trials before."""

from estune.tuners.interface import (
    ConvergenceEstimate,
    CostPrediction,
    PredictingTuner,
    RecordUsingTuner,
    Tuner,
    TunerState,
)
from estune.tuners.observation import Observation
from estune.tuners.registry import (
    DEFAULT_TUNER,
    TUNERS,
    create_tuner,
    tuner_class,
    tuner_from_stored,
    tuner_name,
    tuner_space,
    tuner_to_stored,
)
from estune.tuners.search_space import Coordinates, Point, SearchSpace

__all__ = [
    "DEFAULT_TUNER",
    "TUNERS",
    "ConvergenceEstimate",
    "Coordinates",
    "CostPrediction",
    "Observation",
    "Point",
    "PredictingTuner",
    "RecordUsingTuner",
    "SearchSpace",
    "Tuner",
    "TunerState",
    "create_tuner",
    "tuner_class",
    "tuner_from_stored",
    "tuner_name",
    "tuner_space",
    "tuner_to_stored",
]
