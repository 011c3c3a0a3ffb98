"""Experiments that excite missing effects, sized for a rig.

Levels and amplitudes follow the rig's limits and its suggested step, times its settling time,
frequencies its sampling rate. Where the rig's description has a linear model, an excitation is
scaled so that the predicted tension, too, stays within the limits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.trial import LinearModel, RigDescription
from estune.trial.profiles import (
    MOST_LINES,
    AnyProfile,
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    TriangleProfile,
)
from plants.simulation.plant import drive_of

MARGIN = 0.1
"""Share of the range between the limits that is kept free at either end."""
WIDEST = 4.0
"""Greatest range in suggested steps: limits may be far wider than the operating range."""
QUIET = 0.2
"""Hold at the preload before each excitation, in time units: it shows the noise."""
LOW_Hz = 0.5
"""Lowest frequency, per time unit."""
HIGHEST = 0.45
"""Highest line of a multisine, relative to the sampling rate."""
PER_SETTLING = 8.0
"""Time unit of a fast plant, in settling times."""
BAND_END = 6.0
"""Upper end of a multisine's low band, in 1/settling time."""
OWN_SHARE = 0.25
"""First rms of a multisine, relative to half the range; a crest factor is near 2."""
SMALLEST = 0.02
"""Least share of its first size to which an excitation may be scaled down."""


class Experiment(NamedTuple):
    """A trial to be run: name as part of a file name, title in words, setpoint."""

    name: str
    title: str
    profile: AnyProfile


@dataclass(frozen=True)
class ExperimentDesigner:
    """Designs open-loop experiments within the limits of a rig.

    Each design is None where hardly anything of it would remain within the limits. Levels are
    shares of the range, times in units of `unit_s`.
    """

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
        return max(settling_s, min(1.0, PER_SETTLING * settling_s))

    @cached_property
    def range_N(self) -> tuple[float, float]:
        """Setpoints to be used: within the limits, margins kept, about the suggested step."""
        limits, (low, high) = self.rig.limits, self.rig.step.extremes_N
        size = WIDEST / 2.0 * (high - low)
        low, high = max(limits.tension_min_N, low - size), min(limits.tension_max_N, high + size)
        margin = MARGIN * (high - low)
        return low + margin, high - margin

    @property
    def small(self) -> float:
        """Relative amplitude of a small triangle: a free drum near zero force shows friction."""
        return 0.2 if self.open_only else 1.0

    def allows(self, profile: AnyProfile) -> bool:
        """Whether the rig's limits allow a profile."""
        low, high = profile.extremes_N
        limits = self.rig.limits
        return (
            limits.tension_min_N <= low
            and high <= limits.tension_max_N
            and profile.duration_s <= limits.duration_max_s
        )

    def triangle(
        self, name: str, level: float, *, share: float, period: float, cycles: float
    ) -> Experiment | None:
        """A triangle about a level; its amplitude is a share of that allowed there."""
        at, start, span = self._level_N(level), self._seconds(QUIET), self._seconds(period)
        return self._experiment(
            f"triangle-{name}",
            f"a triangle of {span:g} s about {at:.3g} N",
            lambda size: TriangleProfile(
                at, size, span, start + cycles * span, start, loop="open"
            ),
            size_N=share * self._amplitude_N(at),
            centre_N=at,
        )

    def turning(
        self, name: str, *, share: float, period: float, cycles: float
    ) -> Experiment | None:
        """Pulses that turn a drum onward: zero mean force of a cycle, but not zero mean speed."""
        made = self.triangle(name, 0.0, share=share, period=period, cycles=cycles)
        return made and made._replace(title=f"pulses that turn the drum onward, {period:g} s each")

    def minor_loops(self, level: float, *, period: float, cycles: int) -> Experiment | None:
        """Triangles about a level that shrink from one to the next."""
        at, start, span = self._level_N(level), self._seconds(QUIET), self._seconds(period)
        end = start + cycles * span
        return self._experiment(
            "minor-loops",
            f"loops about {at:.3g} N that shrink from one to the next",
            lambda size: TriangleProfile(at, size, span, end, start, shrink=0.7, loop="open"),
            size_N=self._amplitude_N(at),
            centre_N=at,
        )

    def stairs(self, name: str, *, stairs: int, hold: float, cycles: int) -> Experiment | None:
        """Stairs up and down over the range."""
        if self.open_only:
            return None  # a constant force would accelerate a free drum without end
        low, high = self.range_N
        centre, start, span = 0.5 * (low + high), self._seconds(QUIET), self._seconds(hold)
        end = start + 2 * stairs * cycles * span
        return self._experiment(
            name,
            f"{stairs} stairs up and down, {span:g} s each",
            lambda size: StaircaseProfile(
                centre - 0.5 * size, size / stairs, stairs, span, end, start, loop="open"
            ),
            size_N=high - low,
            centre_N=centre,
        )

    def multisine(self, level: float, *, periods: int, lines: Any) -> Experiment | None:
        """A multisine from low frequency to the plant's bandwidth."""
        at, rate = self._level_N(level), self.rig.controller.sampling_Hz
        period, start = self._seconds(2.0), self._seconds(QUIET)
        last = min(BAND_END / self.rig.settling_time_s, HIGHEST * rate)
        if self.open_only:
            last = min(0.1 * rate, 60.0 / self.unit_s)
        first_line, last_line = max(1, round(LOW_Hz / self.unit_s * period)), _line(last, period)
        return self._experiment(
            f"multisine-{lines.replace('_', '-')}",
            f"a multisine about {at:.3g} N up to {last:.3g} Hz",
            lambda size: MultisineProfile(
                *(at, size, period, first_line, last_line, start + periods * period, start),
                lines=lines,
                loop="open",
            ),
            size_N=OWN_SHARE * self._amplitude_N(at),
            centre_N=at,
        )

    def high_multisine(self, level: float, *, periods: int) -> Experiment | None:
        """A multisine up to nearly half the sampling rate."""
        at, rate = self._level_N(level), self.rig.controller.sampling_Hz
        period, start = self._seconds(1.0), self._seconds(QUIET)
        first, last = 0.1 * rate, HIGHEST * rate
        end = start + periods * period
        return self._experiment(
            "multisine-high",
            f"a multisine about {at:.3g} N from {first:.3g} to {last:.3g} Hz",
            lambda size: MultisineProfile(
                *(at, size, period, _line(first, period), _line(last, period), end, start),
                slope=1.0,
                corner_Hz=first,
                loop="open",
            ),
            size_N=2.0 * OWN_SHARE * self._amplitude_N(at),
            centre_N=at,
        )

    def chirp(self, level: float, *, length: float) -> Experiment | None:
        """A sweep up to a sixth of the sampling rate."""
        at, start = self._level_N(level), self._seconds(QUIET)
        last, end = 0.15 * self.rig.controller.sampling_Hz, start + self._seconds(length)
        return self._experiment(
            "chirp",
            f"a sweep about {at:.3g} N up to {last:.3g} Hz",
            lambda size: ChirpProfile(
                at, size, LOW_Hz / self.unit_s, last, end, start, loop="open"
            ),
            size_N=0.5 * self._amplitude_N(at),
            centre_N=at,
        )

    def _level_N(self, share: float) -> float:
        """A setpoint at a share of the range; zero without a cable."""
        low, high = self.range_N
        return 0.0 if self.open_only else low + share * (high - low)

    def _amplitude_N(self, level_N: float) -> float:
        """Amplitude allowed about a level."""
        low, high = self.range_N
        return min(high - level_N, level_N - low)

    def _seconds(self, units: float) -> float:
        """A time as a whole number of samples, s."""
        rate = self.rig.controller.sampling_Hz
        return round(units * self.unit_s * rate) / rate

    def _experiment(
        self,
        name: str,
        title: str,
        make: Callable[[float], AnyProfile],
        *,
        size_N: float,
        centre_N: float,
    ) -> Experiment | None:
        """The experiment scaled to the limits of setpoint and predicted tension."""
        low, high = self.range_N
        size = size_N
        if not size_N > 0.0:
            return None
        for _ in range(3):  # the response is linear in the size, its extremes nearly so
            profile = make(size)
            setpoint_low, setpoint_high = profile.extremes_N
            predicted_low, predicted_high = self._predicted_extremes_N(profile)
            excess = max(
                _excess(centre_N, min(setpoint_low, predicted_low), low),
                _excess(-centre_N, -max(setpoint_high, predicted_high), -high),
            )
            if excess <= 1.0:
                break
            size /= excess * 1.0001
            if size < SMALLEST * size_N:
                return None
        else:
            profile = make(size)
        return Experiment(name, title, profile) if self.allows(profile) else None

    def _predicted_extremes_N(self, profile: AnyProfile) -> tuple[float, float]:
        """Extremes of the predicted tension."""
        model, rate = self.rig.linear_model, self.rig.controller.sampling_Hz
        if profile.loop == "closed" or model is None or self.open_only:
            return profile.extremes_N
        drive = drive_of(profile, rate)
        effort_N = drive.setpoint_N - profile.preload_N
        tension = profile.preload_N + linear_response(model, effort_N, rate)
        return float(tension.min()), float(tension.max())


def linear_response(model: LinearModel, effort_N: FloatArray, sampling_Hz: float) -> FloatArray:
    """Response of a linear model to an effort held between samples, from rest, shape (samples,).

    Whole samples of the dead time are left out: they shift the response, and change no extreme.
    """
    from scipy.linalg import expm  # noqa: PLC0415  slow to import
    from scipy.signal import lfilter, ss2tf  # noqa: PLC0415  slow to import

    n = len(model.B)
    A, B = np.reshape(model.A, (n, n)), np.reshape(model.B, (n, 1))
    held = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) / sampling_Hz)
    above, below = ss2tf(held[:n, :n], held[:n, n:], np.reshape(model.C, (1, n)), [[model.E]])
    response: FloatArray = lfilter(above[0], below, effort_N)
    return response


def initial_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments that together excite most effects that a model may lack.

    About 28 s for a rig that settles within a second, longer in proportion for a slower one: two
    multisines, slow and faster triangles over the range, stairs, shrinking loops, a sweep and,
    where there is a tension to be controlled, two closed-loop steps.
    """
    design = ExperimentDesigner(rig)
    experiments = [
        design.multisine(0.45, periods=3, lines="odd_sparse"),
        design.triangle("wide", 0.5, share=1.0, period=4.0, cycles=1.0),
        design.triangle("low", 0.25, share=design.small, period=1.0, cycles=2.5),
        design.stairs("stairs", stairs=4, hold=0.4, cycles=1),
        design.minor_loops(0.55, period=0.6, cycles=6),
        design.multisine(0.55, periods=2, lines="all"),
        design.chirp(0.4, length=2.8),
    ]
    if not design.open_only and design.allows(rig.step):
        step = rig.step
        back = replace(step, preload_N=step.preload_N + step.step_N, step_N=-step.step_N)
        experiments += [
            Experiment("step", "the rig's own step", step),
            Experiment("step-back", "the rig's own step back", back),
        ]
    else:
        experiments.append(design.turning("turn", share=0.5, period=1.6, cycles=1.5))
    return tuple(one for one in experiments if one is not None)


def candidate_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments to choose the deciding one from, open loop, of 10 time units at most."""
    design = ExperimentDesigner(rig)
    levels = ((0.2, "low"), (0.5, "middle"), (0.8, "high"))
    experiments = [
        design.triangle(f"slow-{name}", level, share=1.0, period=4.0, cycles=2.0)
        for level, name in (levels[:1] if design.open_only else levels)
    ]
    experiments += [
        design.triangle("ramp", 0.5, share=0.5, period=9.0, cycles=1.0),
        design.minor_loops(0.5, period=1.0, cycles=9),
        design.high_multisine(0.5, periods=4),
        design.multisine(0.5, periods=4, lines="odd_sparse"),
        design.chirp(0.5, length=8.0),
        design.stairs("staircase", stairs=5, hold=0.5, cycles=2),
        design.stairs("long-hold", stairs=1, hold=4.0, cycles=1),
    ]
    if design.open_only:
        experiments += [
            design.turning("turn-slowly", share=0.25, period=2.0, cycles=4.0),
            design.turning("turn-fast", share=1.0, period=2.0, cycles=4.0),
            design.triangle("small", 0.5, share=design.small, period=1.0, cycles=8.0),
        ]
    return tuple(one for one in experiments if one is not None)


def _line(frequency_Hz: float, period_s: float) -> int:
    return min(max(2, math.floor(frequency_Hz * period_s)), MOST_LINES)


def _excess(level: float, low: float, least: float) -> float:
    """Ratio of a level's distance to its lowest value to that of its lower limit."""
    return (level - low) / max(level - least, 1e-12)
