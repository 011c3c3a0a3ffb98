"""The trial that excites a loop where the step trials of a run do not.

It is a closed-loop multisine about the preload, or about the middle of the step where there is
more room, with the gains of the safe trial of least cost. It is as large as the loop needs to be
known (`estune.loop_model.excitation`), and no larger than a trial may be: setpoint and measurement
stay within half a step of their mean, and the effort within half of its room.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.excitation import UnknownLoop, deviations, wanted_setpoint
from estune.loop_model.plant_error import ErrorMargin
from estune.loop_model.records import LoopRecord
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


class ForeseenExcitation(NamedTuple):
    """An excitation, what it does and what it will leave unknown, by the model.

    Attributes:
        answer: Its record, without noise.
        margin: What the plant's error will leave of the loop in question.
    """

    trial: ExcitationTrial
    answer: LoopRecord
    margin: ErrorMargin


def excitation_trial(
    unknown: UnknownLoop, plan: Plan, rig: RigDescription
) -> ExcitationTrial | None:
    """The trial that makes a loop known, or pays; None where none within the limits does."""
    best = best_excitation(unknown, plan, rig)
    return best.trial if best and unknown.pays(best.margin) else None


def best_excitation(
    unknown: UnknownLoop, plan: Plan, rig: RigDescription
) -> ForeseenExcitation | None:
    """The excitation that leaves the most of the loop's distance from -1; None where none can.

    The fewer lines it has the larger each may be: of bands that end ever an octave lower, and
    begin at the first line or one or two octaves below their end, the best one is taken. On
    1/(s^2-1) with noise of 0.3 % of the step and Ms 1.563 all 299 lines leave it up to 1.606, the
    first 18 lines 1.588, those from 9 to 18 1.581, where one more step leaves 1.612.
    """
    rate = rig.controller.sampling_Hz
    powers, found = unknown.powers, list[ForeseenExcitation]()
    for unit in _units(plan, rig):
        samples = unit.samples(rate)
        turn = math.tau / (unit.period_s * rate)
        lowest, highest = unit.first_line * turn, unit.last_line * turn
        power = 0.5 * samples / unit.excited.size  # of each line, over that of white noise
        wanted = wanted_setpoint(unknown, samples, lowest, highest) / math.sqrt(power)
        if not math.isfinite(wanted):
            return None
        wave = _wave(unit, rate)
        output, effort = deviations(unknown, wave)
        moved = float(max(np.abs(output).max(), np.abs(wave).max()))
        allowed = _allowed(unknown, plan, rig, moved, float(np.abs(effort).max()))
        largest = max(allowed, key=lambda at: at.rms, default=None)
        if largest is None:
            continue
        rms = min(wanted, largest.rms)
        profile = replace(unit, preload_N=largest.preload, rms_N=rms)
        trial = ExcitationTrial(unknown.excited_at, profile)
        margin = unknown.margin(powers.bound(rms * effort))
        moves = rms * effort, rms * output, rms * wave
        answer = LoopRecord(*moves, unknown.excited_at, at_rest=True)
        found.append(ForeseenExcitation(trial, answer, margin))
    return max(found, key=lambda one: one.margin.distance, default=None)


@lru_cache(maxsize=16)
def _wave(unit: MultisineProfile, rate: float) -> FloatArray:
    """The multisine about its mean; that of a run is asked for after each of its trials."""
    wave = unit.setpoint(rate) - unit.preload_N
    wave.flags.writeable = False
    return wave


def _units(plan: Plan, rig: RigDescription) -> Iterator[MultisineProfile]:
    """Multisines of rms one, as long as the step trial; none where that is too short."""
    rate, step = rig.controller.sampling_Hz, plan.step
    start = step.step_index(rate)
    load = step.shape(rate).load
    period = (load.sample if load else step.samples(rate)) - start
    last = min((period - 1) // 2, MOST_LINES)  # the controller acts up to half the rate
    while last >= LINES_MIN:
        for first in (1, last // 4 + 1, last // 2 + 1):
            if last - first + 1 >= LINES_MIN:
                yield MultisineProfile(
                    preload_N=step.preload_N,
                    rms_N=1.0,
                    period_s=period / rate,
                    first_line=first,
                    last_line=last,
                    duration_s=step.duration_s,
                    start_s=start / rate,
                )
        last //= 2


class _Allowed(NamedTuple):
    """The largest multisine about a level, in the unit of the measurement."""

    rms: float
    preload: float


def _allowed(
    unknown: UnknownLoop, plan: Plan, rig: RigDescription, moved: float, driven: float
) -> Iterator[_Allowed]:
    """The largest multisine about the preload, and about the middle of the step.

    Args:
        moved: Largest deviation of setpoint and measurement for a multisine of rms one.
        driven: That of the effort.
    """
    limits, settings, half = rig.limits, rig.controller, 0.5 * abs(plan.step.step_N)
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
