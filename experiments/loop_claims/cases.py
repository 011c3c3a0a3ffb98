"""The plants of the searches: families within the class, others outside it, and random loops."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from experiments.loop_claims.truth import with_noise
from experiments.loop_prior import loops
from experiments.sample_efficiency.problems import PROBLEMS, WEAK_ON_A_REEL
from plants.effects import (
    Backlash,
    CableStiffening,
    CoulombFriction,
    DahlHysteresis,
    Effect,
    EyeletFriction,
    StribeckFriction,
    StructuralMode,
    TorqueRipple,
)
from plants.simulation.plant import Plant

RECORD_NOISE = 0.004
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
}
"""Effects on the reference reel that no linear model has, at their usual size."""

RANDOM_BEYOND = 4000
"""First seed of the random loops less that of the searches."""


class LoopCase(NamedTuple):
    """A plant to be tuned.

    Attributes:
        name: Short name.
        kind: "family", "outside" or "random".
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
