"""The plants of the searches: families within the class, others outside it, and random loops."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.trial.profiles import StepProfile
from experiments.loop_claims.truth import with_noise
from experiments.loop_prior import loops
from experiments.sample_efficiency.problems import (
    DERIVATIVE_FILTER_S,
    PROBLEMS,
    SAMPLING_HZ,
    WEAK_ON_A_REEL,
)
from plants.effects import (
    Backlash,
    CableStiffening,
    CoulombFriction,
    CurrentSaturation,
    DahlHysteresis,
    Effect,
    EyeletFriction,
    GaugeDrift,
    GaugeNonlinearity,
    MainsInterference,
    RateLimit,
    StribeckFriction,
    StructuralMode,
    TorqueRipple,
)
from plants.simulation.plant import Plant

RECORD_NOISE, MODE_NOISE = 0.004, 0.003
"""Noise of plants that have none of their own, as a share of the step."""

OUTSIDE: dict[str, Callable[[], Effect]] = {
    "Coulomb 0.005 N m": partial(CoulombFriction, 0.005),
    "Coulomb 0.02 N m": partial(CoulombFriction, 0.02),
    "Coulomb 0.05 N m": partial(CoulombFriction, 0.05),
    "eyelet 0.93": partial(EyeletFriction, 0.93),
    "backlash": Backlash,
    "torque ripple": TorqueRipple,
    "stiffening": CableStiffening,
    "mode at 25 Hz": partial(StructuralMode, frequency_Hz=25.0),
    "Dahl friction": DahlHysteresis,
    "Stribeck friction": StribeckFriction,
    "stiffening, twice": partial(CableStiffening, 0.05),
    "softening gauge": partial(GaugeNonlinearity, -0.01),
    "saturation": partial(CurrentSaturation, 1.6),
    "rate limit": partial(RateLimit, 60.0),
    "drift": partial(GaugeDrift, 0.5),
    "mains": MainsInterference,
}
"""Effects on the reference reel that no linear model has, at their usual size."""

BASE_Hz = 4.0
"""Frequency of the plant that modes are added to."""

MODE_RANGES = {"share": (0.005, 0.1), "damping": (0.001, 0.03), "ratio": (2.0, 30.0)}
"""Ranges of a mode: its static gain over the plant's, its damping, its frequency over the plant's;
each is drawn evenly in its logarithm."""

RANDOM_BEYOND = 4000
"""First seed of the random loops less that of the searches."""


class LoopCase(NamedTuple):
    """A plant to be tuned.

    Attributes:
        name: Short name.
        kind: "family", "outside", "mode" or "random".
        plant: The plant, with measurement noise.
        cost: The cost of a trial.
        start: Initial gains.
    """

    name: str
    kind: str
    plant: Plant
    cost: StepCost
    start: Gains


def families() -> Iterator[LoopCase]:
    """The families of `experiments.sample_efficiency`."""
    for name, problem in PROBLEMS.items():
        plant = with_noise(problem.build(), RECORD_NOISE)
        yield LoopCase(name, "family", plant, problem.cost, problem.start)


def outside() -> Iterator[LoopCase]:
    """The reference reel with an effect that no linear model has."""
    for name, effect in OUTSIDE.items():
        plant = plants.reference_reel() + effect()
        yield LoopCase(name, "outside", plant, PROBLEMS["friction"].cost, WEAK_ON_A_REEL)


def modes(count: int, seed0: int) -> Iterator[LoopCase]:
    """A plant of two poles with a mode beside it in phase or antiphase, or behind it."""
    for seed in range(seed0 + RANDOM_BEYOND, seed0 + RANDOM_BEYOND + count):
        yield mode_case(seed)


def mode_case(seed: int, noise: float = MODE_NOISE) -> LoopCase:
    """The mode of a seed."""
    import control  # noqa: PLC0415  slow to import

    rng = np.random.default_rng(seed)
    share, damping, ratio = (
        math.exp(rng.uniform(math.log(low), math.log(high))) for low, high in MODE_RANGES.values()
    )
    where = ("in phase", "in antiphase", "in series")[seed % 3]
    w = 2.0 * math.pi * BASE_Hz
    plant = control.tf([w * w], [1.0, 0.4 * w, w * w])
    v = ratio * w
    mode = control.tf([v * v], [1.0, 2.0 * damping * v, v * v])
    if where == "in series":
        system, name = plant * ((1.0 - share) + share * mode), f"{where}, share {share:.1%}"
    else:
        sign = 1.0 if where == "in phase" else -1.0
        system, name = plant + sign * share * mode, f"{where}, share {share:.1%}"
    label = f"mode {seed}: {ratio * BASE_Hz:.0f} Hz, {name}, damping {damping:.1%}"
    return of_system(label, system, noise)


def of_system(name: str, system: Any, noise: float = MODE_NOISE) -> LoopCase:
    """The tuning of a linear system of python-control whose slowest mode is at `BASE_Hz`."""
    rate = SAMPLING_HZ
    made = plants.linear_plant(
        system,
        dead_time_s=2.0 / rate,
        sampling_Hz=rate,
        output_min_N=-4.0,
        output_max_N=4.0,
        derivative_filter_s=DERIVATIVE_FILTER_S,
        profile=StepProfile(0.0, 1.0, 0.1, 1.5),
    )
    cost = StepCost(1.0 / BASE_Hz, time_unit="settling_time", move_weight=2.0)
    plant = with_noise(made, noise)
    return LoopCase(name, "mode", plant, cost, Gains(0.15, 4.0, 0.003, 0.08))


def random_loops(count: int, seed0: int) -> Iterator[LoopCase]:
    """Loops drawn at random whose optimum lies within the bounds."""
    found, seed = 0, seed0 + RANDOM_BEYOND
    while found < count:
        case = _random_loop(seed)
        seed += 1
        if case is not None:
            found += 1
            yield case


def _random_loop(seed: int) -> LoopCase | None:
    drawn = loops.draw_loop(seed)
    if drawn is None:
        return None
    noisy = with_noise(drawn.plant, RECORD_NOISE)
    start = Gains(*np.exp(drawn.start).tolist())
    return LoopCase(f"random {seed}", "random", noisy, drawn.cost, start)
