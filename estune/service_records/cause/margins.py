"""How tight the identified loop is, and by what factor its gains could be smaller or larger."""

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.loop_signals import Controller
from estune.service_records.cause.predictors import FittedPredictor

SENSITIVITY = 1.7
"""Ms that the stated factor of the gains leads to: between the 1.4 and 2 of textbooks."""

_ANGLES = np.geomspace(1e-3, np.pi, 600)
LEAST = 1.0 / 30.0
"""Least factor of the gains that is tried, and the inverse of the greatest."""

UNSTABLE = 50.0
"""Ms that stands for an unstable loop."""


def sensitivity(plant: FittedPredictor, controller: Controller, factor: float = 1.0) -> float:
    """Ms of the loop with all gains times a factor; `UNSTABLE` for an unstable one."""
    loop = factor * _loop(plant, controller)
    if _encircles(loop):
        return UNSTABLE
    return min(float(np.max(1.0 / np.abs(1.0 + loop))), UNSTABLE)


def room(plant: FittedPredictor, controller: Controller) -> float:
    """Factor of all gains at which the loop has `SENSITIVITY`; `LEAST` where none has."""
    low, high = np.log(LEAST), -np.log(LEAST)
    for _ in range(20):
        middle = 0.5 * (low + high)
        tight = sensitivity(plant, controller, float(np.exp(middle))) > SENSITIVITY
        low, high = (low, middle) if tight else (middle, high)
    return float(np.exp(low))


def peak(plant: FittedPredictor, controller: Controller) -> float:
    """Angle per sample at which the loop is most sensitive."""
    return float(_ANGLES[np.argmax(1.0 / np.abs(1.0 + _loop(plant, controller)))])


def _loop(plant: FittedPredictor, controller: Controller) -> FloatArray:
    back = np.exp(-1j * _ANGLES)
    lag = (1.0 - plant.pole or 1.0) / (1.0 - plant.pole * back)
    late = plant.delay + 0.5 * (plant.order == 3)
    process = plant.gain * back**late * lag ** (2 if plant.order == 2 and plant.pole < 1.0 else 1)
    control = controller.P + controller.I / (1.0 - back) + controller.D * (1.0 - back)
    return np.asarray(process * control)


def _encircles(loop: FloatArray) -> bool:
    """Whether the curve passes beyond -1 on the negative real axis from below to above."""
    real, imaginary = loop.real, loop.imag
    crossing = (imaginary[:-1] < 0.0) & (imaginary[1:] >= 0.0)
    return bool((crossing & (real[:-1] < -1.0)).any())
