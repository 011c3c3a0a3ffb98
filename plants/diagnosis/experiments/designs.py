"""Experiments that excite missing effects, sized for a rig.

Levels and amplitudes follow the rig's limits and its suggested step, times its settling time,
frequencies its sampling rate. Where the rig's description has a linear model, an excitation is
scaled so that the predicted tension, too, stays within the limits.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.trial import LinearModel, RigDescription
from estune.trial.profiles import (
    MOST_LINES,
    AnyProfile,
    ChirpProfile,
    Lines,
    MultisineProfile,
    StaircaseProfile,
    TriangleProfile,
)
from plants.simulation.plant import drive_of

WIDEST = 4.0
"""Greatest range in suggested steps: limits may be far wider than the operating range."""


class Experiment(NamedTuple):
    """A trial to be run: name as part of a file name, title in words, setpoint."""

    name: str
    title: str
    profile: AnyProfile


Make = Callable[["RigScale", float, float], AnyProfile]
"""A setpoint about a level, of a size, both in N."""


class Design(NamedTuple):
    """An open-loop experiment for any rig.

    Attributes:
        make: Its setpoint; times in units of `RigScale.unit_s`.
        level: Mean setpoint, as a share of the rig's range.
        cabled: First size, as a share of the amplitude allowed there; None: not with a cable.
        free: That for a drum without a cable, about no force; None: not without a cable.
    """

    name: str
    title: str
    make: Make
    level: float = 0.5
    cabled: float | None = 1.0
    free: float | None = 1.0


@dataclass(frozen=True)
class RigScale:
    """Levels and times of a rig that experiments are sized by."""

    rig: RigDescription

    @property
    def open_only(self) -> bool:
        """Whether there is no tension to be controlled: a reel without a cable."""
        return self.rig.step.loop == "open"

    @property
    def unit_s(self) -> float:
        """The unit of time: a second for a reel, its settling time for a slower plant.

        A plant that settles within less than an eighth of a second has a shorter one.
        """
        settling_s = self.rig.settling_time_s
        return max(settling_s, min(1.0, 8.0 * settling_s))

    @cached_property
    def range_N(self) -> tuple[float, float]:
        """Setpoints to be used: within the limits, margins kept, about the suggested step."""
        limits, (low, high) = self.rig.limits, self.rig.step.extremes
        size = WIDEST / 2.0 * (high - low)
        low, high = max(limits.tension_min_N, low - size), min(limits.tension_max_N, high + size)
        # A tenth of the range stays free at either end.
        margin = 0.1 * (high - low)
        return low + margin, high - margin

    @property
    def sampling_Hz(self) -> float:
        """The rig's sampling rate."""
        return self.rig.controller.sampling_Hz

    @property
    def start_s(self) -> float:
        """Hold before an excitation, s: it shows the noise."""
        return self.seconds(0.2)

    def seconds(self, units: float) -> float:
        """A time as a whole number of samples, s."""
        return round(units * self.unit_s * self.sampling_Hz) / self.sampling_Hz

    def allows(self, profile: AnyProfile) -> bool:
        """Whether the rig's limits allow a profile."""
        low, high = profile.extremes
        limits = self.rig.limits
        within = limits.tension_min_N <= low and high <= limits.tension_max_N
        return within and profile.duration_s <= limits.duration_max_s

    def experiment(self, design: Design) -> Experiment | None:
        """A design scaled to the limits of setpoint and predicted tension.

        None where it is not for this rig, or hardly anything of it would remain.
        """
        low, high = self.range_N
        share = design.free if self.open_only else design.cabled
        at = 0.0 if self.open_only else low + design.level * (high - low)
        first = size = (share or 0.0) * min(high - at, at - low)
        if not first > 0.0:
            return None
        for _ in range(4):  # the response is linear in the size, its extremes nearly so
            profile = design.make(self, at, size)
            lowest, highest = self._extremes_N(profile)
            excess = max(_excess(at, lowest, low), _excess(-at, -highest, -high))
            if excess <= 1.0:
                break
            size /= excess * 1.0001
            if size < 0.02 * first:
                return None
        made = Experiment(design.name, design.title.format(profile), profile)
        return made if self.allows(profile) else None

    def _extremes_N(self, profile: AnyProfile) -> tuple[float, float]:
        model, (low, high) = self.rig.linear_model, profile.extremes
        if model is None or self.open_only:
            return low, high
        effort_N = drive_of(profile, self.sampling_Hz).setpoint_N - profile.preload_N
        tension = profile.preload_N + linear_response(model, effort_N, self.sampling_Hz)
        return min(low, float(tension.min())), max(high, float(tension.max()))


def linear_response(model: LinearModel, effort_N: FloatArray, sampling_Hz: float) -> FloatArray:
    """Response of a linear model to an effort held between samples, from rest, shape (samples,).

    Whole samples of the dead time are left out: they shift the response, and change no extreme.
    """
    from scipy.signal import cont2discrete, lfilter, ss2tf  # noqa: PLC0415  slow to import

    n = len(model.B)
    A, B = np.reshape(model.A, (n, n)), np.reshape(model.B, (n, 1))
    held = cont2discrete((A, B, np.reshape(model.C, (1, n)), [[model.E]]), 1.0 / sampling_Hz)
    above, below = ss2tf(*held[:4])
    response: FloatArray = lfilter(above[0], below, effort_N)
    return response


def _triangle(period: float, cycles: float, shrink: float = 1.0) -> Make:
    def make(rig: RigScale, at: float, size: float) -> AnyProfile:
        start, span = rig.start_s, rig.seconds(period)
        end = start + cycles * span
        return TriangleProfile(at, size, span, end, start, shrink=shrink, loop="open")

    return make


def _stairs(stairs: int, hold: float, cycles: int) -> Make:
    def make(rig: RigScale, at: float, size: float) -> AnyProfile:
        start, span = rig.start_s, rig.seconds(hold)
        end = start + 2 * stairs * cycles * span
        step = 2.0 * size / stairs
        return StaircaseProfile(at - size, step, stairs, span, end, start, loop="open")

    return make


def _multisine(periods: int, lines: Lines) -> Make:
    """From low frequency to the plant's bandwidth."""

    def make(rig: RigScale, at: float, size: float) -> AnyProfile:
        start, span = rig.start_s, rig.seconds(2.0)
        last_Hz = min(6.0 / rig.rig.settling_time_s, 0.45 * rig.sampling_Hz)
        if rig.open_only:
            last_Hz = min(0.1 * rig.sampling_Hz, 60.0 / rig.unit_s)
        band = max(1, round(0.5 / rig.unit_s * span)), _line(last_Hz, span)
        end = start + periods * span
        return MultisineProfile(at, size, span, *band, end, start, lines=lines, loop="open")

    return make


def _high_multisine(rig: RigScale, at: float, size: float) -> AnyProfile:
    """Up to nearly half the sampling rate."""
    start, span, first_Hz = rig.start_s, rig.seconds(1.0), 0.1 * rig.sampling_Hz
    band = _line(first_Hz, span), _line(0.45 * rig.sampling_Hz, span)
    end, shape = start + 4 * span, (1.0, first_Hz)
    return MultisineProfile(at, size, span, *band, end, start, "all", *shape, loop="open")


def _chirp(length: float) -> Make:
    def make(rig: RigScale, at: float, size: float) -> AnyProfile:
        start, last_Hz = rig.start_s, 0.15 * rig.sampling_Hz
        end = start + rig.seconds(length)
        return ChirpProfile(at, size, 0.5 / rig.unit_s, last_Hz, end, start, loop="open")

    return make


TRIANGLE = "a triangle of {0.period_s:g} s about {0.preload_N:.3g} N"
ONWARD = "pulses that turn the drum onward, {0.period_s:g} s each"
"""Triangles of zero mean force, but not zero mean speed."""
LOOPS = "loops about {0.preload_N:.3g} N that shrink from one to the next"
SINES = "a multisine about {0.preload_N:.3g} N up to {0.last_Hz:.3g} Hz"
SWEEP = "a sweep about {0.preload_N:.3g} N up to {0.last_Hz:.3g} Hz"
STAIRS = "{0.stairs} stairs up and down, {0.hold_s:g} s each"

INITIAL = (
    Design("multisine-odd-sparse", SINES, _multisine(3, "odd_sparse"), 0.45, 0.25, 0.25),
    Design("triangle-wide", TRIANGLE, _triangle(4.0, 1.0)),
    Design("triangle-low", TRIANGLE, _triangle(1.0, 2.5), 0.25, free=0.2),
    Design("stairs", STAIRS, _stairs(4, 0.4, 1), free=None),
    Design("minor-loops", LOOPS, _triangle(0.6, 6, shrink=0.7), 0.55),
    Design("multisine-all", SINES, _multisine(2, "all"), 0.55, 0.25, 0.25),
    Design("chirp", SWEEP, _chirp(2.8), 0.4, 0.5, 0.5),
    Design("triangle-turn", ONWARD, _triangle(1.6, 1.5), cabled=None, free=0.5),
)
CANDIDATES = (
    Design("triangle-slow-low", TRIANGLE, _triangle(4.0, 2.0), 0.2),
    Design("triangle-slow-middle", TRIANGLE, _triangle(4.0, 2.0), 0.5, free=None),
    Design("triangle-slow-high", TRIANGLE, _triangle(4.0, 2.0), 0.8, free=None),
    Design("triangle-ramp", TRIANGLE, _triangle(9.0, 1.0), 0.5, 0.5, 0.5),
    Design("minor-loops", LOOPS, _triangle(1.0, 9, shrink=0.7)),
    Design("multisine-high", SINES, _high_multisine, 0.5, 0.5, 0.5),
    Design("multisine-odd-sparse", SINES, _multisine(4, "odd_sparse"), 0.5, 0.25, 0.25),
    Design("chirp", SWEEP, _chirp(8.0), 0.5, 0.5, 0.5),
    # A constant force would accelerate a free drum without end.
    Design("staircase", STAIRS, _stairs(5, 0.5, 2), free=None),
    Design("long-hold", STAIRS, _stairs(1, 4.0, 1), free=None),
    Design("triangle-turn-slowly", ONWARD, _triangle(2.0, 4.0), cabled=None, free=0.25),
    Design("triangle-turn-fast", ONWARD, _triangle(2.0, 4.0), cabled=None),
    Design("triangle-small", TRIANGLE, _triangle(1.0, 8.0), cabled=None, free=0.2),
)


def initial_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments that together excite most effects that a model may lack.

    About 28 s for a rig that settles within a second, longer in proportion for a slower one: two
    multisines, slow and faster triangles over the range, stairs, shrinking loops, a sweep and,
    where there is a tension to be controlled, two closed-loop steps.
    """
    scale, step, made = RigScale(rig), rig.step, _made(rig, INITIAL)
    if scale.open_only or not scale.allows(step):
        return made
    back = replace(step, preload_N=step.preload_N + step.step_N, step_N=-step.step_N)
    steps = ("step", "the rig's own step", step), ("step-back", "the rig's own step back", back)
    return (*made, *(Experiment(*experiment) for experiment in steps))


def candidate_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments to choose the deciding one from, open loop, of 10 time units at most."""
    return _made(rig, CANDIDATES)


def _made(rig: RigDescription, designs: Sequence[Design]) -> tuple[Experiment, ...]:
    scale = RigScale(rig)
    return tuple(
        experiment for experiment in map(scale.experiment, designs) if experiment is not None
    )


def _line(frequency_Hz: float, period_s: float) -> int:
    return min(max(2, math.floor(frequency_Hz * period_s)), MOST_LINES)


def _excess(level: float, low: float, least: float) -> float:
    """Ratio of a level's distance to its lowest value to that of its lower limit."""
    return (level - low) / max(level - least, 1e-12)
