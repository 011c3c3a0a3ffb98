"""Experiments that excite missing effects, sized for a rig.

Levels and amplitudes follow the rig's limits and its suggested step, times its settling time,
frequencies its sampling rate. Where the rig's description has a linear model, an excitation is
scaled so that the predicted tension, too, stays within the limits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

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
QUIET_s = 0.2
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

Sized = TypeVar("Sized", TriangleProfile, MultisineProfile, ChirpProfile, StaircaseProfile)


class Experiment(NamedTuple):
    """A trial to be run: name as part of a file name, title in words, setpoint."""

    name: str
    title: str
    profile: AnyProfile


@dataclass(frozen=True)
class ExperimentLimits:
    """Levels, amplitudes and times that a rig allows."""

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

    def level(self, share: float) -> float:
        """A setpoint at a share of the range, N; without a cable there is but zero."""
        low, high = self.range_N
        return 0.0 if self.open_only else low + share * (high - low)

    def reach(self, level_N: float) -> float:
        """Amplitude allowed about a level, N."""
        low, high = self.range_N
        return min(high - level_N, level_N - low)

    @property
    def small(self) -> float:
        """Relative amplitude of a small triangle: a free drum near zero force shows friction."""
        return 0.2 if self.open_only else 1.0

    def seconds(self, units: float) -> float:
        """A time of so many units, as a whole number of samples, s."""
        rate = self.rig.controller.sampling_Hz
        return round(units * self.unit_s * rate) / rate

    def allows(self, profile: AnyProfile) -> bool:
        """Whether the rig's limits allow a profile."""
        low, high = profile.extremes_N
        limits = self.rig.limits
        return (
            limits.tension_min_N <= low
            and high <= limits.tension_max_N
            and profile.duration_s <= limits.duration_max_s
        )

    def fitted(
        self, make: Callable[[float], Sized], size_N: float, centre_N: float
    ) -> Sized | None:
        """A profile scaled from `size_N` to the limits of setpoint and predicted tension.

        Args:
            make: The profile of a size.
            size_N: Its greatest size.
            centre_N: Level about which it is scaled.

        Returns:
            None where it would be scaled below `SMALLEST`.
        """
        low, high = self.range_N
        size = size_N
        for _ in range(3):  # the response is linear in the size, its extremes nearly so
            profile = make(size)
            setpoint_low, setpoint_high = profile.extremes_N
            answer_low, answer_high = self._answer(profile)
            over = max(
                _over(centre_N, min(setpoint_low, answer_low), low),
                _over(-centre_N, -max(setpoint_high, answer_high), -high),
            )
            if over <= 1.0:
                return profile if self.allows(profile) else None
            size /= over * 1.0001
            if size < SMALLEST * size_N:
                return None
        profile = make(size)
        return profile if self.allows(profile) else None

    def _answer(self, profile: AnyProfile) -> tuple[float, float]:
        """Extremes of the predicted tension, N."""
        model = self.rig.linear_model
        if profile.loop == "closed" or model is None or self.open_only:
            return profile.extremes_N
        drive = drive_of(profile, self.rig.controller.sampling_Hz)
        tension = profile.preload_N + answer(
            model, drive.setpoint_N - profile.preload_N, self.rig.controller.sampling_Hz
        )
        return float(tension.min()), float(tension.max())


def answer(model: LinearModel, effort_N: FloatArray, sampling_Hz: float) -> FloatArray:
    """Response of a linear model to an effort held between samples, from rest, shape (samples,).

    Whole samples of the dead time are left out: they shift the response, and change no extreme.
    """
    from scipy.linalg import expm  # noqa: PLC0415  slow to import
    from scipy.signal import lfilter, ss2tf  # noqa: PLC0415  slow to import

    n = len(model.B)
    A, B = np.reshape(model.A, (n, n)), np.reshape(model.B, (n, 1))
    held = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) / sampling_Hz)
    above, below = ss2tf(held[:n, :n], held[:n, n:], np.reshape(model.C, (1, n)), [[model.E]])
    found: FloatArray = lfilter(above[0], below, effort_N)
    return found


def initial_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments that together excite most effects that a model may lack.

    About 28 s for a rig that settles within a second, longer in proportion for a slower one: two
    multisines, slow and faster triangles over the range, stairs, shrinking loops, a sweep and,
    where there is a tension to be controlled, two closed-loop steps.
    """
    limits = ExperimentLimits(rig)
    most = [
        _multisine(limits, 0.45, periods=3, lines="odd_sparse"),
        _triangle(limits, 0.5, "wide", share=1.0, period=4.0, cycles=1.0),
        _triangle(limits, 0.25, "low", share=limits.small, period=1.0, cycles=2.5),
        _stairs(limits, "stairs", stairs=4, hold=0.4, cycles=1),
        _minor_loops(limits, 0.55, period=0.6, cycles=6),
        _multisine(limits, 0.55, periods=2, lines="all"),
        _chirp(limits, 0.4, length=2.8),
    ]
    found = [one for one in most if one is not None]
    if not limits.open_only and limits.allows(rig.step):
        step = rig.step
        again = replace(step, preload_N=step.preload_N + step.step_N, step_N=-step.step_N)
        found += [
            Experiment("step", "the rig's own step", step),
            Experiment("step-back", "the rig's own step back", again),
        ]
    else:
        turning = _turning(limits, "turn", share=0.5, period=1.6, cycles=1.5)
        found += [turning] if turning else []
    return tuple(found)


def candidate_experiments(rig: RigDescription) -> tuple[Experiment, ...]:
    """Experiments to choose the deciding one from, open loop, of 10 time units at most."""
    limits = ExperimentLimits(rig)
    found: list[Experiment | None] = []
    for share, name in ((0.2, "low"), (0.5, "middle"), (0.8, "high")):
        found.append(_triangle(limits, share, f"slow-{name}", share=1.0, period=4.0, cycles=2.0))
        if limits.open_only:
            break  # without a cable there is one level
    found += [
        _triangle(limits, 0.5, "ramp", share=0.5, period=9.0, cycles=1.0),
        _minor_loops(limits, 0.5, period=1.0, cycles=9),
        _high_multisine(limits, 0.5, periods=4),
        _multisine(limits, 0.5, periods=4, lines="odd_sparse"),
        _chirp(limits, 0.5, length=8.0),
        _stairs(limits, "staircase", stairs=5, hold=0.5, cycles=2),
        _stairs(limits, "long-hold", stairs=1, hold=4.0, cycles=1),
    ]
    if limits.open_only:
        found += [
            _turning(limits, "turn-slowly", share=0.25, period=2.0, cycles=4.0),
            _turning(limits, "turn-fast", share=1.0, period=2.0, cycles=4.0),
            _triangle(limits, 0.5, "small", share=limits.small, period=1.0, cycles=8.0),
        ]
    return tuple(one for one in found if one is not None)


def _named(
    limits: ExperimentLimits,
    name: str,
    title: str,
    make: Callable[[float], Any],
    *,
    size_N: float,
    centre_N: float,
) -> Experiment | None:
    profile = limits.fitted(make, size_N, centre_N) if size_N > 0.0 else None
    return None if profile is None else Experiment(name, title, profile)


def _triangle(
    limits: ExperimentLimits,
    level: float,
    name: str,
    *,
    share: float,
    period: float,
    cycles: float,
) -> Experiment | None:
    at, start = limits.level(level), limits.seconds(QUIET_s)
    span = limits.seconds(period)
    return _named(
        limits,
        f"triangle-{name}",
        f"a triangle of {span:g} s about {at:.3g} N",
        lambda size: TriangleProfile(at, size, span, start + cycles * span, start, loop="open"),
        size_N=share * limits.reach(at),
        centre_N=at,
    )


def _turning(
    limits: ExperimentLimits, name: str, *, share: float, period: float, cycles: float
) -> Experiment | None:
    """Pulses that turn the drum onward: the mean force of a cycle is zero, the mean speed not."""
    made = _triangle(limits, 0.0, name, share=share, period=period, cycles=cycles)
    return made and made._replace(title=f"pulses that turn the drum onward, {period:g} s each")


def _minor_loops(
    limits: ExperimentLimits, level: float, *, period: float, cycles: int
) -> Experiment | None:
    at, start, span = limits.level(level), limits.seconds(QUIET_s), limits.seconds(period)
    return _named(
        limits,
        "minor-loops",
        f"loops about {at:.3g} N that shrink from one to the next",
        lambda size: TriangleProfile(
            at, size, span, start + cycles * span, start, shrink=0.7, loop="open"
        ),
        size_N=limits.reach(at),
        centre_N=at,
    )


def _stairs(
    limits: ExperimentLimits, name: str, *, stairs: int, hold: float, cycles: int
) -> Experiment | None:
    if limits.open_only:
        return None  # a constant force would accelerate a free drum without end
    low, high = limits.range_N
    centre = 0.5 * (low + high)
    start, span = limits.seconds(QUIET_s), limits.seconds(hold)
    return _named(
        limits,
        name,
        f"{stairs} stairs up and down, {span:g} s each",
        lambda size: StaircaseProfile(
            *(centre - 0.5 * size, size / stairs, stairs, span),
            *(start + 2 * stairs * cycles * span, start),
            loop="open",
        ),
        size_N=high - low,
        centre_N=centre,
    )


def _multisine(
    limits: ExperimentLimits, level: float, *, periods: int, lines: Any
) -> Experiment | None:
    at, rate = limits.level(level), limits.rig.controller.sampling_Hz
    period, start = limits.seconds(2.0), limits.seconds(QUIET_s)
    last = min(BAND_END / limits.rig.settling_time_s, HIGHEST * rate)
    if limits.open_only:
        last = min(0.1 * rate, 60.0 / limits.unit_s)
    return _named(
        limits,
        f"multisine-{lines.replace('_', '-')}",
        f"a multisine about {at:.3g} N up to {last:.3g} Hz",
        lambda size: MultisineProfile(
            *(
                at,
                size,
                period,
                max(1, round(LOW_Hz / limits.unit_s * period)),
                _line(last, period),
            ),
            *(start + periods * period, start),
            lines=lines,
            loop="open",
        ),
        size_N=OWN_SHARE * limits.reach(at),
        centre_N=at,
    )


def _high_multisine(limits: ExperimentLimits, level: float, *, periods: int) -> Experiment | None:
    at, rate = limits.level(level), limits.rig.controller.sampling_Hz
    period, start = limits.seconds(1.0), limits.seconds(QUIET_s)
    first, last = 0.1 * rate, HIGHEST * rate
    return _named(
        limits,
        "multisine-high",
        f"a multisine about {at:.3g} N from {first:.3g} to {last:.3g} Hz",
        lambda size: MultisineProfile(
            *(at, size, period, _line(first, period), _line(last, period)),
            *(start + periods * period, start),
            slope=1.0,
            corner_Hz=first,
            loop="open",
        ),
        size_N=2.0 * OWN_SHARE * limits.reach(at),
        centre_N=at,
    )


def _chirp(limits: ExperimentLimits, level: float, *, length: float) -> Experiment | None:
    at, rate = limits.level(level), limits.rig.controller.sampling_Hz
    start = limits.seconds(QUIET_s)
    last = 0.15 * rate
    return _named(
        limits,
        "chirp",
        f"a sweep about {at:.3g} N up to {last:.3g} Hz",
        lambda size: ChirpProfile(
            *(at, size, LOW_Hz / limits.unit_s, last, start + limits.seconds(length), start),
            loop="open",
        ),
        size_N=0.5 * limits.reach(at),
        centre_N=at,
    )


def _line(frequency_Hz: float, period_s: float) -> int:
    return min(max(2, math.floor(frequency_Hz * period_s)), MOST_LINES)


def _over(level: float, low: float, least: float) -> float:
    """Ratio of a level's distance to its lowest value to that of its lower limit."""
    return (level - low) / max(level - least, 1e-12)
