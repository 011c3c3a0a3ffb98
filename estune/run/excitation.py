"""The trial that excites a loop where the step trials of a run do not.

It is a closed-loop multisine about the preload, or about the middle of the step where there is
more room, with the gains of the safe trial of least cost. It is as large as the loop needs to be
known (`estune.loop_model.excitation`), and no larger than a trial may be: setpoint and measurement
stay within half a step of their mean, and the effort within half of its room.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.excitation import (
    UnknownLoop,
    is_enough,
    largest_deviations,
    wanted_setpoint,
)
from estune.run.plan import Plan
from estune.trial import RigDescription
from estune.trial.profiles import MOST_LINES, MultisineProfile

EFFORT_SHARE = 0.5
"""Share of the effort's room to its limits that an excitation may use: the model is not exact."""

LINES_MIN = 8
"""Least number of lines: with fewer a mode falls between them."""


class ExcitationTrial(NamedTuple):
    """A trial that excites the loop."""

    gains: Gains
    profile: MultisineProfile


def excitation_trial(
    unknown: UnknownLoop, plan: Plan, rig: RigDescription
) -> ExcitationTrial | None:
    """The trial that makes a loop known; None where none within the limits does."""
    unit = _unit(plan, rig)
    if unit is None:
        return None
    samples = unit.samples(rig.controller.sampling_Hz)
    power = 0.5 * samples / unit.excited.size  # of each line, over that of white noise
    wanted = wanted_setpoint(unknown, samples) / math.sqrt(power)
    if not math.isfinite(wanted):
        return None
    wave = unit.setpoint(rig.controller.sampling_Hz) - unit.preload_N
    largest = max(_allowed(unknown, plan, rig, wave), key=lambda at: at.rms, default=None)
    if largest is None or not is_enough(largest.rms, wanted):
        return None
    rms = min(wanted, largest.rms)
    profile = replace(unit, preload_N=largest.preload, rms_N=rms)
    return ExcitationTrial(unknown.excited_at, profile)


def _unit(plan: Plan, rig: RigDescription) -> MultisineProfile | None:
    """A multisine of rms one, as long as the step trial; None where that is too short."""
    rate, step = rig.controller.sampling_Hz, plan.step
    start = step.step_index(rate)
    load = step.shape(rate).load
    period = (load.sample if load else step.samples(rate)) - start
    last = min((period - 1) // 2, MOST_LINES)  # the controller acts up to half the rate
    if last < LINES_MIN:
        return None
    return MultisineProfile(
        preload_N=step.preload_N,
        rms_N=1.0,
        period_s=period / rate,
        first_line=1,
        last_line=last,
        duration_s=step.duration_s,
        start_s=start / rate,
    )


class _Allowed(NamedTuple):
    """The largest multisine about a level, in the unit of the measurement."""

    rms: float
    preload: float


def _allowed(
    unknown: UnknownLoop, plan: Plan, rig: RigDescription, wave: np.ndarray
) -> Iterator[_Allowed]:
    """The largest multisine about the preload, and about the middle of the step."""
    limits, settings, half = rig.limits, rig.controller, 0.5 * abs(plan.step.step_N)
    model, gains = unknown.fit.model, unknown.excited_at
    moved, driven = largest_deviations(model, gains, settings, wave)
    moved = max(moved, float(np.abs(wave).max()))
    for share in (0.0, 0.5):
        level = plan.step.preload_N + share * plan.step.step_N
        room = min(half, level - limits.tension_min_N, limits.tension_max_N - level)
        effort = _effort_at(unknown, share)
        effort_room = min(effort - settings.output_min_N, settings.output_max_N - effort)
        rms = min(room / moved, EFFORT_SHARE * effort_room / driven)
        if rms > 0.0:
            yield _Allowed(rms, level)


def _effort_at(unknown: UnknownLoop, share: float) -> float:
    """Effort at rest at a share of the step, by the first of the step trials."""
    step = unknown.records[0]
    last = float(step.effort[-max(step.samples // 10, 1) :].mean())
    return (1.0 - share) * step.rest_effort + share * last
