"""Probabilities of the causes from the evidence of a log.

Two logistic regressions, fitted to simulated loops of known cause by
`./dev python -m experiments.service_records.cause_weights`. Which evidence tells of sticking was
chosen with 25 logs of a plant in view; no measured log took part in the weights. Whether the
actuator sticks is decided first: by what the valve foretells beyond a linear loop, in how many
blocks and without the best of them, how large its band is at least, how tight the linear loop is,
and shapes. The lower end of the band's interval parts simulated loops that were left out best.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.evidence import NAMES
from estune.service_records.cause.weights import OTHERS, STICKING, Weights

CauseName = Literal["tuning", "sticking", "outside", "sensor", "none", "unknown"]

FOR_STICKING = (
    "gain", "without best", "curved", "moving", "offset", "informed", "together", "returns",
    "noise", "blocks", "band", "least band", "Ms", "room",
)  # fmt: skip
FOR_OTHERS = (
    "informed", "slow", "curved", "moving", "returns", "later", "line", "sharp",
    "line of error", "beside peak", "Ms", "room", "jump", "together", "noise",
)  # fmt: skip
SQUARED = ("returns", "line", "Ms", "room", "beside peak", "jump")

FARTHEST = 3.0
"""Deviations beyond which evidence is as strong as there: no simulated loop lay farther."""


def sticking_terms(numbers: FloatArray) -> FloatArray:
    """Terms of the regression of sticking, shape (..., terms): squares, products by the gain."""
    chosen = _columns(numbers, FOR_STICKING)
    return np.concatenate([chosen, chosen**2, chosen[..., 1:] * chosen[..., :1]], axis=-1)


def other_terms(numbers: FloatArray) -> FloatArray:
    """Terms of the regression of tuning, outside and none, shape (..., terms)."""
    squares = _columns(numbers, SQUARED) ** 2
    return np.concatenate([_columns(numbers, FOR_OTHERS), squares], axis=-1)


def probabilities(numbers: FloatArray) -> dict[CauseName, float]:
    """Probability of each cause but the sensor, which `sensor` tells by its laws."""
    sticks = float(_shares(sticking_terms(numbers), STICKING)[1])
    others = _shares(other_terms(numbers), OTHERS)
    tuning, outside, none = ((1.0 - sticks) * others).tolist()
    return {"tuning": tuning, "sticking": sticks, "outside": outside, "none": none}


def _columns(numbers: FloatArray, names: Sequence[str]) -> FloatArray:
    return np.asarray(numbers[..., [NAMES.index(name) for name in names]])


def _shares(terms: FloatArray, weights: Weights) -> FloatArray:
    mean, deviation = np.array(weights.mean), np.array(weights.deviation)
    away = np.clip((terms - mean) / deviation, -FARTHEST, FARTHEST)
    score = np.array([0.0, *(np.array(weights.constant) + np.array(weights.slopes) @ away)])
    score = np.exp(score - score.max())
    return np.asarray(score / score.sum())
