"""The answer of a loop to the setpoint of a record, with the limits of its effort."""

import math
from dataclasses import replace

import numpy as np

from estune.core.controller_equation import controller_polynomials
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

DIVERGED = 1e100
"""Size of an answer that is none: squares of such overflow."""


def setpoint_response(
    model: LoopModel, record: LoopRecord, gains: Gains, settings: ControllerSettings
) -> tuple[FloatArray, FloatArray]:
    """Output and effort that the setpoint of a record alone causes, as deviations, (samples,).

    From rest at the first sample. Not finite where the loop is unstable and no limit holds it.

    Args:
        record: The record, with the limits at which its effort was held.
        settings: The fixed part of the controller.
    """
    moves = record.setpoint - record.setpoint[0]
    low, high = (limit - record.effort[0] for limit in record.limits)
    with np.errstate(over="ignore", invalid="ignore"):
        output, effort = _bounded(close_loop(model, gains, settings).setpoint_response(moves))
    if low <= effort.min() and effort.max() <= high:
        return output, effort
    if not (math.isfinite(low) or math.isfinite(high)):
        return output, effort
    limits = min(low, 0.0), max(high, 0.0)
    return _bounded(_by_samples(model, moves, gains, settings, limits))


def _bounded(answer: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Output and effort, infinite where they have diverged."""
    output, effort = np.where(np.abs(answer) < DIVERGED, answer, math.inf)
    return output, effort


def _by_samples(
    model: LoopModel,
    moves: FloatArray,
    gains: Gains,
    settings: ControllerSettings,
    limits: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """The same sample by sample. The integral stays within the limits, as the effort does.

    As controllers for heaters and motors run it: the effort leaves a limit where the error asks
    for it. By the equation of differences it would leave as soon as the error turns, and a kettle
    that swings with a period of 178 samples would with 115.
    """
    A, B = plant_polynomials(model)
    held = replace(gains, I=0.0)
    law, without = controller_law(settings, held), controller_polynomials(settings, held)
    whole = controller_polynomials(settings, gains)
    filtered = lfilter(whole.filter_numerator, whole.filter_denominator, moves)
    asked = np.convolve(law.setpoint, filtered)
    summed = np.convolve(whole.setpoint - without.setpoint, filtered)
    S, S_sum = law.measurement[::-1], (whole.measurement - without.measurement)[::-1]
    R, R_sum = law.denominator[:0:-1], whole.denominator[:0:-1]
    late, past = model.dead_samples + 1, B.size + A.size + S.size + S_sum.size
    B, A = B[late:][::-1], A[:0:-1]
    output, effort, moved, sums = np.zeros((4, past + moves.size))
    low, high = limits
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(past, past + moves.size):
            driven = B @ effort[k - late - B.size + 1 : k - late + 1]
            output[k] = driven - A @ output[k - A.size : k]
            moved[k] = asked[k - past] - S @ output[k - S.size + 1 : k + 1]
            moved[k] -= R @ moved[k - R.size : k]
            more = summed[k - past] - S_sum @ output[k - S_sum.size + 1 : k + 1]
            sums[k] = min(max(more - R_sum @ sums[k - R_sum.size : k], low), high)
            effort[k] = min(max(moved[k] + sums[k], low), high)
    return output[past:], effort[past:]
