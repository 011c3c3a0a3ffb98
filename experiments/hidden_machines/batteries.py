"""Which records are taken of a machine: about 28 s of them, open and closed loop mixed."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.hidden_machines import signals
from experiments.hidden_machines.bases import Base
from experiments.hidden_machines.effects import force

Column = NDArray[np.float64]
Rng = np.random.Generator


class RecordPlan(NamedTuple):
    """One record to be taken.

    Attributes:
        profile: The kind of setpoint.
        loop: `open`, or `closed` by a tension or angle controller.
        setpoint: Force or tension, N; angle, rad, for a closed loop without a cable.
        repeats: Number of the plan of which this is a repeat, or None.
        fed: Force fed in at the drum beside the controller's, N, or None.
    """

    profile: str
    loop: str
    setpoint: Column
    repeats: int | None = None
    fed: Column | None = None


def tensioned(rng: Rng, base: Base) -> list[RecordPlan]:
    """Tensions from 3 to 38 N; the cable never goes slack."""
    rate = base.rate_Hz
    low, mid, high = rng.uniform(8.0, 11.0), rng.uniform(14.0, 18.0), rng.uniform(19.0, 23.0)
    size = rng.uniform(4.0, 7.0)
    first = RecordPlan("step", "closed", signals.steps(rate, 2.4, [mid, mid + 1.5 * size, mid]))
    return [
        first,
        RecordPlan(
            "step", "open", signals.steps(rate, 2.4, [high, high + size, high - size, high])
        ),
        RecordPlan(
            "triangle", "open", signals.triangle(rate, 4.0, 20.0, rng.uniform(12.0, 15.0), 2)
        ),
        _multisine(rng, base, 1.0, 4, high, rms=rng.uniform(5.0, 6.5)),
        RecordPlan(
            "chirp",
            "open",
            signals.sweep(rate, 3.0, mid, rng.uniform(1.2, 1.8), low=0.7, high=60.0),
        ),
        RecordPlan("custom", "closed", _staircase(rng, rate, 4.0, 7.0, 35.0)),
        _multisine(rng, base, 1.0, 3, low, rms=rng.uniform(2.0, 2.6)),
        first._replace(repeats=0),
        RecordPlan(
            "triangle", "closed", signals.triangle(rate, 3.0, mid, rng.uniform(5.0, 9.0), 3)
        ),
    ]


def low(rng: Rng, base: Base) -> list[RecordPlan]:
    """Tensions from next to nothing to 12 N."""
    rate = base.rate_Hz
    first = RecordPlan("step", "open", signals.steps(rate, 2.4, [3.0, 5.0, 2.5]))
    return [
        first,
        RecordPlan("step", "closed", signals.steps(rate, 2.4, [4.0, 9.0, 3.0])),
        RecordPlan("triangle", "open", signals.triangle(rate, 4.0, 5.0, rng.uniform(4.3, 4.8), 2)),
        _multisine(rng, base, 1.0, 4, rng.uniform(4.0, 5.5), rms=rng.uniform(0.9, 1.2)),
        RecordPlan(
            "chirp",
            "open",
            signals.sweep(rate, 3.0, 4.0, rng.uniform(0.5, 0.7), low=0.7, high=60.0),
        ),
        RecordPlan("custom", "closed", _staircase(rng, rate, 4.0, 2.0, 12.0)),
        _multisine(rng, base, 1.0, 3, rng.uniform(7.0, 9.0), rms=rng.uniform(1.5, 2.0)),
        first._replace(repeats=0),
        RecordPlan("triangle", "open", signals.triangle(rate, 3.0, 4.0, 3.4, 1)),
    ]


def parting(rng: Rng, base: Base) -> list[RecordPlan]:
    """Tensions up to 12 N, and forces through zero and back, short ones: the cable goes slack.

    A mean force winds the drum back in, as gravity brings back a ball that was thrown. Forces
    change slowly or seldom: teeth that rattle cannot be foretold for long.
    """
    rate = base.rate_Hz
    first = RecordPlan("step", "closed", signals.steps(rate, 2.4, [4.0, 9.0, 3.0]))
    return [
        first,
        RecordPlan("custom", "open", signals.reversals(rng, rate, 4.0, 3.0, 3.0)),
        RecordPlan(
            "triangle", "closed", signals.triangle(rate, 4.0, 3.2, rng.uniform(2.7, 3.1), 2)
        ),
        RecordPlan(
            "chirp",
            "open",
            signals.sweep(rate, 3.0, 3.0, rng.uniform(4.5, 5.5), low=0.8, high=8.0),
        ),
        _multisine(rng, base, 1.0, 3, rng.uniform(7.0, 9.0), rms=rng.uniform(1.5, 2.0)),
        RecordPlan("custom", "open", signals.reversals(rng, rate, 3.0, 3.0, 4.0)),
        first._replace(repeats=0),
        RecordPlan("triangle", "open", signals.triangle(rate, 3.0, 3.0, rng.uniform(5.0, 6.5), 6)),
        RecordPlan("custom", "closed", _staircase(rng, rate, 4.0, 2.0, 12.0)),
    ]


def soft(rng: Rng, base: Base) -> list[RecordPlan]:
    """The same tensions on a cord so soft that the drum turns far and slowly."""
    rate = base.rate_Hz
    first = RecordPlan("step", "open", signals.steps(rate, 3.0, [14.0, 20.0, 14.0]))
    return [
        first,
        RecordPlan(
            "triangle", "open", signals.triangle(rate, 6.0, 20.0, rng.uniform(11.0, 14.0), 1)
        ),
        _multisine(rng, base, 2.0, 3, 20.0, rms=rng.uniform(3.0, 4.0), high_Hz=40.0),
        RecordPlan("custom", "open", _staircase(rng, rate, 5.0, 9.0, 30.0)),
        first._replace(repeats=0),
        RecordPlan(
            "chirp",
            "open",
            signals.sweep(rate, 4.0, 18.0, rng.uniform(1.5, 2.5), low=0.3, high=20.0),
        ),
        RecordPlan("triangle", "open", signals.triangle(rate, 4.0, 16.0, 6.0, 1)),
    ]


def steps_only(rng: Rng, base: Base) -> list[RecordPlan]:
    """Nothing but steps, at several tensions."""
    rate, plans = base.rate_Hz, []
    for n in range(11):
        level, size = rng.uniform(10.0, 24.0), rng.uniform(3.0, 9.0) * rng.choice([-1, 1])
        size = -abs(size) if level > 20.0 else size if level > 15.0 else abs(size)
        if n % 2 and abs(size) > 6.0:
            size *= 0.7  # in open loop it overshoots
        levels = [level, level + size, level]
        plans.append(
            RecordPlan("step", "open" if n % 2 else "closed", signals.steps(rate, 2.4, levels))
        )
    return [*plans, plans[0]._replace(repeats=0)]


def unloaded(rng: Rng, base: Base) -> list[RecordPlan]:
    """No cable: forces about zero, or an angle that is followed."""
    rate, F = base.rate_Hz, force(base)
    turn = {"unloaded": 1.0, "stage": 0.06}[base.kind]
    first = RecordPlan(
        "step", "open", signals.steps(rate, 2.6, [0.0, 0.8 * F, -0.8 * F, 0.6 * F, 0.0])
    )
    around = [0.0, 1.0, -0.6, 1.6, 0.4]
    small = turn * rng.uniform(0.3, 0.6)
    return [
        first,
        _multisine(rng, base, 1.0, 4, 0.0, rms=F * rng.uniform(0.5, 0.7)),
        RecordPlan(
            "custom",
            "closed",
            signals.smooth_steps(
                rate, 5.0, [turn * a * rng.uniform(0.8, 1.2) for a in around], 0.4
            ),
        ),
        RecordPlan("triangle", "closed", signals.triangle(rate, 5.0, 0.0, turn, 2)),
        RecordPlan(
            "chirp",
            "open",
            signals.sweep(rate, 3.0, 0.0, F * rng.uniform(0.4, 0.7), low=1.0, high=60.0),
        ),
        first._replace(repeats=0),
        RecordPlan("chirp", "closed", signals.sweep(rate, 3.0, 0.0, small, low=0.5, high=4.0)),
        _multisine(rng, base, 1.0, 3, 0.0, rms=F * rng.uniform(0.25, 0.4)),
    ]


def reversing(rng: Rng, base: Base) -> list[RecordPlan]:
    """No cable, and forces that turn round slowly enough for teeth not to rattle.

    What a wide multisine about zero does to a gear with play nobody foretells: each time the teeth
    meet multiplies what is not known of the time before.
    """
    rate, F = base.rate_Hz, force(base)
    plans = unloaded(rng, base)
    waves = [
        _multisine(rng, base, 1.0, periods, 0.0, rms=F * rms, high_Hz=10.0)
        for periods, rms in ((4, rng.uniform(0.5, 0.7)), (3, rng.uniform(0.25, 0.4)))
    ]
    swept = signals.sweep(rate, 3.0, 0.0, F * rng.uniform(0.4, 0.7), low=1.0, high=12.0)
    return [
        *plans[:1],
        waves[0],
        *plans[2:4],
        plans[4]._replace(setpoint=swept),
        *plans[5:7],
        waves[1],
    ]


def stage(rng: Rng, base: Base) -> list[RecordPlan]:
    """A position controller only, as of a machine tool; the same kind of motion throughout."""
    rate = base.rate_Hz
    plans = []
    for n in range(6):
        targets = rng.uniform(-0.1, 0.1, 4)
        targets[0] = 0.0
        profile = signals.smooth_steps(rate, 4.0, list(targets), rng.uniform(0.6, 0.9))
        plans.append(RecordPlan("custom", "closed", profile))
        if n == 3:
            plans.append(plans[0]._replace(repeats=0))
    return plans


def _staircase(rng: Rng, rate: float, seconds: float, least: float, most: float) -> Column:
    levels = np.linspace(least, most, 6) + rng.uniform(-0.05, 0.05, 6) * (most - least)
    order = [0, 2, 4, 5, 3, 1]
    return signals.steps(rate, seconds, [float(levels[n]) for n in order])


def _multisine(
    rng: Rng,
    base: Base,
    period_s: float,
    periods: int,
    mean: float,
    *,
    rms: float,
    high_Hz: float = 110.0,
) -> RecordPlan:
    wave = signals.multisine(rng, base.rate_Hz, period_s, periods, mean, rms=rms, high_Hz=high_Hz)
    return RecordPlan("multisine", "open", wave)
