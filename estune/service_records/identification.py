"""The loop identified from stretches of ordinary service."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import unlimited_effort
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.fitting import fit_loop_of_any_scale
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import close_loop
from estune.loop_model.plant_error import PlantErrorBound, plant_error
from estune.loop_model.records import LoopRecord
from estune.service_records.stretches import Stretch

SCALES_APART = 6.0
"""Ratio of the settling times that are tried: one search covers frequencies from 0.1 to 1.5 of its
own scale."""

FASTEST = 12.0
"""Samples of the shortest settling time that is tried; a loop is sampled ten times as fast as it
settles, at least."""

LONGEST_SHARE = 0.1
"""Share of the longest stretch that the longest settling time may be."""


LONGEST_RESPONSE = 1 << 20
"""Samples of the longest step response by which a settling time is found."""


class ServicePart(NamedTuple):
    """A stretch and the gains that ran in it."""

    stretch: Stretch
    gains: Gains


class ServiceLoop(NamedTuple):
    """A loop identified from records of service.

    Attributes:
        fit: The fit.
        records: The records it was fitted to.
        settings: The fixed part of the controller.
        error: Bound of the error of the identified plant.
    """

    fit: LoopFit
    records: tuple[LoopRecord, ...]
    settings: ControllerSettings
    error: PlantErrorBound


def identify(
    parts: Sequence[ServicePart], settings: ControllerSettings, settling_time_s: float | None
) -> ServiceLoop:
    """The loop that fits the stretches best.

    Args:
        parts: At least one.
        settings: The fixed part of the controller.
        settling_time_s: About how long the loop takes to settle; None finds it.
    """
    records = tuple(loop_record(part, settings) for part in parts)
    rate = settings.sampling_Hz
    scales = [settling_time_s] if settling_time_s else _scales(records, rate)
    fit = fit_loop_of_any_scale(records, rate, scales)
    return ServiceLoop(fit, records, settings, plant_error(fit, records))


def _scales(records: Sequence[LoopRecord], rate: float) -> list[float]:
    """Settling times that cover the records, s."""
    longest = max(record.samples for record in records)
    count = 1 + round(math.log(max(LONGEST_SHARE * longest / FASTEST, 1.0), SCALES_APART))
    return [FASTEST * SCALES_APART**n / rate for n in range(count)]


def loop_record(part: ServicePart, settings: ControllerSettings) -> LoopRecord:
    """The signals of a stretch; the effort as logged, else computed from the controller."""
    stretch, gains = part
    effort = stretch.effort
    if effort is None:
        effort = unlimited_effort(
            settings, gains, stretch.setpoint, stretch.measurement, first_effort=0.0
        )
        begun = _forgotten(settings, gains)
        if stretch.samples > 2 * begun:
            cut = slice(begun, None)
            signals = effort[cut], stretch.measurement[cut], stretch.setpoint[cut]
            return LoopRecord(*signals, gains)
    return LoopRecord(effort, stretch.measurement, stretch.setpoint, gains)


def _forgotten(settings: ControllerSettings, gains: Gains) -> int:
    """Samples after which the controller's filters have forgotten the states they began with."""
    longest_s = max(gains.setpoint_filter_s, settings.derivative_filter_s)
    return math.ceil(5.0 * longest_s * settings.sampling_Hz)


def settling_time(loop: ServiceLoop, gains: Gains) -> float:
    """Time after which a step response with these gains stays within 2 % of its end, s.

    Infinite where the loop is unstable.
    """
    closed = close_loop(loop.fit.model, gains, loop.settings)
    samples = 64
    while samples <= LONGEST_RESPONSE:
        output = closed.setpoint_response(np.ones(samples))[0]
        if not np.isfinite(output).all():
            return math.inf
        end = float(output[-1])
        outside = np.flatnonzero(np.abs(output - end) > 0.02 * abs(end))
        last = int(outside[-1]) + 1 if outside.size else 1
        if last < samples // 2:
            return last / loop.settings.sampling_Hz
        samples *= 4
    return math.inf


def effort_span(loop: ServiceLoop, record: LoopRecord) -> float:
    """Range of the effort that the setpoint of a record alone causes, in its unit."""
    if record.gains is None:
        return 0.0
    moves: FloatArray = record.setpoint - record.setpoint[0]
    closed = close_loop(loop.fit.model, record.gains, loop.settings)
    effort = closed.setpoint_response(moves)[1]
    return float(np.ptp(effort)) if np.isfinite(effort).all() else 0.0
