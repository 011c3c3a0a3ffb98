"""The answer of a loop to the setpoint of a record, with the limits of its effort."""

import math

import numpy as np

from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.model import (
    LoopModel,
    close_loop,
    controller_law,
    plant_polynomials,
)
from estune.loop_model.records import LoopRecord


def setpoint_response(
    model: LoopModel, record: LoopRecord, gains: Gains, settings: ControllerSettings
) -> tuple[FloatArray, FloatArray]:
    """Output and effort that the setpoint of a record alone causes, as deviations, (samples,).

    From rest at the first sample. Not finite where the loop is unstable and no limit holds it.

    Args:
        model: The loop.
        record: The record, with the limits at which its effort was held.
        gains: The gains.
        settings: The fixed part of the controller.
    """
    moves = record.setpoint - record.setpoint[0]
    low, high = (limit - record.effort[0] for limit in record.limits)
    with np.errstate(over="ignore", invalid="ignore"):
        output, effort = close_loop(model, gains, settings).setpoint_response(moves)
    if low <= effort.min() and effort.max() <= high:
        return output, effort
    if not (math.isfinite(low) or math.isfinite(high)):
        return output, effort
    return _by_samples(model, moves, gains, settings, (min(low, 0.0), max(high, 0.0)))


def _by_samples(
    model: LoopModel,
    moves: FloatArray,
    gains: Gains,
    settings: ControllerSettings,
    limits: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """The same sample by sample. The integral holds at a limit, by the equation of differences."""
    law, (A, B) = controller_law(settings, gains), plant_polynomials(model)
    asked = np.convolve(law.setpoint, lfilter(law.filter_numerator, law.filter_denominator, moves))
    late, past = model.dead_samples + 1, B.size + A.size + law.measurement.size
    B, S, R = B[late:][::-1], law.measurement[::-1], law.denominator[:0:-1]
    A = A[:0:-1]
    output, effort = np.zeros(past + moves.size), np.zeros(past + moves.size)
    low, high = limits
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(past, past + moves.size):
            driven = B @ effort[k - late - B.size + 1 : k - late + 1]
            output[k] = driven - A @ output[k - A.size : k]
            wanted = asked[k - past] - S @ output[k - S.size + 1 : k + 1]
            wanted -= R @ effort[k - R.size : k]
            effort[k] = min(max(wanted, low), high)
    return output[past:], effort[past:]
