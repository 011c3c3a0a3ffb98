"""Cautious live gains for a plant that was given without any.

A plant that is only known as a function is identified first: a doublet of the effort, raised until
the measurement moves by a share of the suggested step, gives the loop model whose margins choose
the gains. A closed-loop trial then has to end near its setpoint.
"""

import math

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import UnsafeStart
from estune.loop_model.cautious_gains import SENSITIVITY_MAX, cautious_gains
from estune.loop_model.fitting import fit_loop
from estune.loop_model.margins import frequency_response, robustness
from estune.loop_model.records import LoopRecord
from plants.models.mounting import HOW_TO_GIVE_GAINS
from plants.simulation.plant import Plant, TrialSetpoint, drive_of

MOVED = 0.1
"""Move of the measurement, as a share of the suggested step, that is enough to identify by."""

EFFORT_SHARE = 0.1
"""Largest doublet, as a share of the controller's range."""

DECADES = 9
"""Doublets that are tried, each ten times the last."""

END_ERROR_MAX = 0.5
"""Largest error at the end of the closed-loop trial, as a share of its step."""


def identified_gains(plant: Plant, settling_time_s: float, rest_effort_N: float) -> Gains:
    """Cautious gains by an identification in open loop.

    Args:
        plant: The plant, which must stay where it is at the effort of its rest.
        settling_time_s: Settling time a good tuning can reach.
        rest_effort_N: Effort at rest at the preload of the suggested step.

    Raises:
        UnsafeStart: the plant does not stay, does not respond, responds the wrong way, or no
            cautious gains hold it.
        PlantError: the plant cannot be simulated.
    """
    record = _doublet(plant, rest_effort_N)
    controller = plant.controller
    model = fit_loop([record], controller.sampling_Hz, settling_time_s).model

    def safe(gains: Gains) -> bool:
        sensitivity = robustness(model, gains, controller).sensitivity
        return sensitivity <= SENSITIVITY_MAX and _holds(plant, gains)

    slow = min(2.0 * math.pi / settling_time_s / controller.sampling_Hz, 3.0)
    size = float(np.abs(frequency_response(model, np.array([slow])))[0])
    gains = cautious_gains(size, settling_time_s, safe)
    if gains is None:
        raise _unknown("no slow PI holds the identified model")
    return gains


def _unknown(why: str) -> UnsafeStart:
    return UnsafeStart(
        f"no safe gains are known for the plant, and an identification in open loop finds none: "
        f"{why}; give gains that hold it stable, {HOW_TO_GIVE_GAINS}"
    )


def _doublet(plant: Plant, rest_effort_N: float) -> LoopRecord:
    """The record of the first doublet that moves the measurement by enough.

    Raises:
        UnsafeStart: the plant drifts away, or no doublet within the limits moves it.
    """
    step, controller = plant.profile, plant.controller
    drive = drive_of(step, controller.sampling_Hz)
    index = max(step.step_index(controller.sampling_Hz), 1)
    third = max((drive.time_s.size - index) // 3, 1)
    shape = np.zeros(drive.time_s.size)
    shape[index : index + third], shape[index + third : index + 2 * third] = 1.0, -1.0
    span = controller.output_max_N - controller.output_min_N
    for size in EFFORT_SHARE * span * 10.0 ** np.arange(-DECADES, 0.5):
        wanted = rest_effort_N + size * shape
        effort = np.clip(wanted, controller.output_min_N, controller.output_max_N)
        measured = _open_loop(plant, drive, effort)
        away = (measured - measured[index - 1]) / abs(step.step_N)
        if not (np.isfinite(away).all() and np.ptp(away[:index]) < MOVED):
            raise _unknown("it does not stay at rest; give the effort and measurement at rest")
        if np.abs(away).max() >= MOVED:
            driven, free = np.split(np.abs(away), [index + 2 * third])
            if free.max() > 2.0 * driven.max():
                raise _unknown("it runs away once it has moved: it is unstable by itself")
            if away[index + third - 1] * (effort[index] - rest_effort_N) < 0.0:
                raise _unknown("more effort lowers the measurement; turn the sign of the effort")
            return LoopRecord.of_step(effort, measured, step.step_N, index)
    most = EFFORT_SHARE * span
    raise _unknown(
        f"an effort of {most:.3g}, {EFFORT_SHARE:.0%} of the controller's range, does not move "
        "it; check that the plant uses its effort"
    )


def _open_loop(plant: Plant, drive: TrialSetpoint, effort_N: FloatArray) -> FloatArray:
    """The measurement for an effort, without noise; NaN where it left the finite range."""
    row = np.array([pidf.coefficients(plant.controller, Gains(1.0, 0.0, 0.0, 0.0))], dtype=float)
    columns = plant.respond(
        row, drive._replace(setpoint_N=effort_N, open_loop=True), None, math.inf
    )
    if columns.ended[0] < effort_N.size:
        return np.full(effort_N.size, math.nan)
    return np.asarray(columns.tension_N[0])


def _holds(plant: Plant, gains: Gains) -> bool:
    """Whether the suggested step ends near its setpoint, never far beyond it."""
    step = plant.profile
    drive = drive_of(step, plant.controller.sampling_Hz)
    row = np.array([pidf.coefficients(plant.controller, gains)], dtype=float)
    columns = plant.respond(row, drive, None, math.inf)
    if columns.ended[0] < drive.time_s.size:
        return False
    error = (drive.setpoint_N - columns.tension_N[0]) / step.step_N
    return bool(abs(error[-1]) < END_ERROR_MAX and error.min() > -END_ERROR_MAX)
