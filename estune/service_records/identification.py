"""The loop identified from stretches of ordinary service."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import unlimited_effort
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.allowed_models import Draws, allowed_draws, plain_draws
from estune.loop_model.beginning import best_scale
from estune.loop_model.fit_signals import REACH
from estune.loop_model.fitting import fit_loop
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.model import close_loop
from estune.loop_model.plant_error import PlantErrorBound, plant_error
from estune.loop_model.records import LoopRecord
from estune.service_records.fitted_part import moved_most, speaks_for
from estune.service_records.stretches import Stretch

SCALES_APART = 6.0
"""Ratio of the settling times that are tried: one search covers frequencies from 0.1 to 1.5 of its
own scale."""

FASTEST = 12.0
"""Samples of the shortest settling time that is tried; a loop is sampled ten times as fast as it
settles, at least."""

LONGEST_SHARE = 0.1
"""Share of the longest stretch that the longest settling time may be."""


LONGEST_RESPONSE = 1 << 16
"""Samples of the longest step response that is predicted; nor is one longer than the records, for
what takes longer they do not show."""

OFF = 10.0
"""Distance of setpoint and measurement, over the noise, from which it is told how the measurement
covers it: the half that is looked for is five deviations then, which noise alone exceeds once in
3 million samples. At the first sample of 28 logs of chambers, kettles and wheels it is 47 to
1 380: those do not decide it."""


class ServicePart(NamedTuple):
    """A stretch and the gains that ran in it."""

    stretch: Stretch
    gains: Gains


class ServiceLoop(NamedTuple):
    """A loop identified from records of service.

    Attributes:
        records: Those that were fitted: of long ones a part (`fitted_part`).
        draws: Models that the records allow; empty for those of the fit's covariances.
        span: Range of the setpoint in all records; of the measurement where no setpoint moves.
    """

    fit: LoopFit
    records: tuple[LoopRecord, ...]
    settings: ControllerSettings
    error: PlantErrorBound
    draws: Draws = ()
    span: float = 0.0


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
    begun = best_scale(records, rate, scales)
    settling = begun.settling_time_s
    rest = round(settling * rate) + REACH
    off = [_begins_off(record, rest) for record in records]
    if any(off):
        pairs = zip(records, off, strict=True)
        switched = [_switched_on(r, rest) if begins_off else r for r, begins_off in pairs]
        begun = best_scale(switched, rate, [settling], begun)
    gains = parts[-1].gains
    fitted, others = moved_most(begun.records, settling * rate)
    fit = fit_loop(fitted, rate, settling, starts=begun.starts)
    if others and not speaks_for(fit, fitted, others, gains, settings):
        fitted = list(begun.records)
        fit = fit_loop(fitted, rate, settling, starts=begun.starts)
    draws = _draws(fit, fitted, settings, gains)
    error = plant_error(fit, fitted)
    return ServiceLoop(fit, tuple(fitted), settings, error, draws, _span(begun.records))


def _span(records: Sequence[LoopRecord]) -> float:
    setpoint = np.concatenate([record.setpoint for record in records])
    measured = np.concatenate([record.measurement for record in records])
    return float(np.ptp(setpoint)) or float(np.ptp(measured))


def _draws(
    fit: LoopFit, records: Sequence[LoopRecord], settings: ControllerSettings, gains: Gains
) -> Draws:
    """The models that the records allow, where the covariances allow unstable loops."""
    if fit.model.friction:
        return ()
    plain = plain_draws(fit)
    unstable = any(
        not math.isfinite(robustness(model, gains, settings).sensitivity)
        for models in plain
        for model in models
    )
    return allowed_draws(fit, records, plain) if unstable else ()


def _begins_off(record: LoopRecord, rest: int) -> bool:
    """Whether a controller was switched on with the first sample: a cold start.

    The measurement covers half of its distance to the setpoint before that moves. Where it does
    not the distance is that of a loop in service, without integral or at a limit.
    """
    setpoint, measurement = record.setpoint, record.measurement
    noise = float(np.std(np.diff(measurement))) / math.sqrt(2.0)
    distance = setpoint[0] - measurement[0]
    if record.samples < rest or abs(distance) <= OFF * noise or not record.effort[0]:
        return False
    covered = (measurement - measurement[0]) / distance
    half = int(np.argmax(covered > 0.5)) or record.samples
    return half < int(np.argmax(setpoint != setpoint[0])) or (
        half < record.samples and not np.ptp(setpoint)
    )


def _switched_on(record: LoopRecord, rest: int) -> LoopRecord:
    """A record behind a rest of so many samples, without effort and error."""
    first = record.measurement[0]

    def behind(value: float, signal: FloatArray) -> FloatArray:
        return np.concatenate([np.full(rest, value), signal])

    return record._replace(
        effort=behind(0.0, record.effort),
        measurement=behind(first, record.measurement),
        setpoint=behind(first, record.setpoint),
    )


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
    signals = effort, stretch.measurement, stretch.setpoint
    return LoopRecord(*signals, gains, limits=stretch.limits)


def _forgotten(settings: ControllerSettings, gains: Gains) -> int:
    """Samples after which the controller's filters have forgotten the states they began with."""
    longest_s = max(gains.setpoint_filter_s, settings.derivative_filter_s)
    return math.ceil(5.0 * longest_s * settings.sampling_Hz)


def settling_time(loop: ServiceLoop, gains: Gains) -> float:
    """Time after which a step response with these gains stays within 2 % of its end, s.

    At most that of the longest record; of an unstable loop a share of it.
    """
    closed, rate = close_loop(loop.fit.model, gains, loop.settings), loop.settings.sampling_Hz
    longest = min(max(record.samples for record in loop.records), LONGEST_RESPONSE)
    if not math.isfinite(robustness(loop.fit.model, gains, loop.settings).sensitivity):
        return LONGEST_SHARE * longest / rate
    samples = 64
    while samples <= 2 * longest:
        output = closed.setpoint_response(np.ones(samples))[0]
        end = float(output[-1])
        outside = np.flatnonzero(np.abs(output - end) > 0.02 * abs(end))
        last = int(outside[-1]) + 1 if outside.size else 1
        if last < samples // 2:
            return last / rate
        samples *= 4
    return longest / rate


def effort_span(loop: ServiceLoop, record: LoopRecord) -> float:
    """Range of the effort that the setpoint of a record alone causes, in its unit."""
    if record.gains is None:
        return 0.0
    effort = setpoint_response(loop.fit.model, record, record.gains, loop.settings)[1]
    return float(np.ptp(effort)) if np.isfinite(effort).all() else 0.0
