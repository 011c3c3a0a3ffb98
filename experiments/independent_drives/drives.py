"""Drives of five kinds, with and without what their owners' models lack.

`drive.c` integrates them; nothing of `plants` is used. A draw gives true numbers, the numbers that
the owner believes, and the effects that the owner does not know of.
"""

import ctypes
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.hidden_machines.machine import compiled

Column = NDArray[np.float64]
SUBSTEP_s = 2e-5
OFF = {"bristle": 1e-5, "bristle_damping": 1.0, "stribeck_speed": 1.0, "warming_s": 1.0}
"""Parameters that are not zero where an effect is absent."""


class DriveKind(NamedTuple):
    """A kind of drive, its sizes and what may be hidden in it.

    Attributes:
        inertia: Usual inertia, kg m2, or mass, kg.
        load_share: Share of it on the far side of gear, spindle or belt.
        settling_s: Inertia over viscous friction.
        travel: Greatest travel, rad or m.
        speed_Hz: Frequency of the usual motion.
        rate_Hz: Sampling rate.
        steps: Steps of encoders that such drives have, rad or m.
        hidden: What is hidden in one case each.
    """

    inertia: float
    load_share: float
    settling_s: float
    travel: float
    speed_Hz: float
    rate_Hz: float
    steps: tuple[float, ...]
    hidden: tuple[tuple[str, ...], ...]


def _turn(*counts: int) -> tuple[float, ...]:
    return tuple(2.0 * math.pi / n for n in counts)


KINDS = {
    "servo": DriveKind(
        *(1.5e-3, 0.8, 0.8, 3.0, 0.8, 1000.0, _turn(4096, 10_000, 65_536)),
        (
            *((), ("coulomb_friction",), ("stribeck_friction",), ("load_friction",)),
            *(("dead_time",), ("bent_viscous_friction",), ("current_saturation",)),
            ("coulomb_friction", "dead_time"),
        ),
    ),
    "stage": DriveKind(
        *(12.0, 0.0, 0.3, 0.12, 0.8, 500.0, (1e-7, 1e-6, 5e-6)),
        (
            *((), ("coulomb_friction",), ("stribeck_friction",), ("dahl_hysteresis",)),
            *(("directional_friction",), ("bent_viscous_friction",), ("knocks",)),
            ("coulomb_friction", "bent_viscous_friction"),
        ),
    ),
    "spindle": DriveKind(
        *(8e-4, 0.5, 0.6, 12.0, 0.7, 1000.0, _turn(2000, 8192, 65_536)),
        (
            *((), ("backlash",), ("backlash",), ("coulomb_friction",), ("torque_ripple",)),
            *(("current_lag",), ("backlash", "coulomb_friction")),
            ("torque_ripple", "coulomb_friction"),
        ),
    ),
    "link": DriveKind(
        *(0.02, 0.9, 1.0, 1.4, 0.5, 500.0, _turn(4096, 20_000, 2**17)),
        (
            *((), ("link_gravity",), ("link_gravity",), ("link_gravity", "coulomb_friction")),
            *(("link_gravity", "stribeck_friction"), ("link_gravity", "dead_time")),
            *(("link_gravity", "load_friction"), ("warming",)),
        ),
    ),
    "conveyor": DriveKind(
        *(0.05, 0.6, 0.5, 25.0, 0.35, 250.0, _turn(1024, 4096, 16_384)),
        (
            *((), ("coulomb_friction",), ("directional_friction",), ("elastic_belt",)),
            *(("dead_time",), ("warming",), ("coulomb_friction", "elastic_belt")),
            ("coulomb_friction", "directional_friction"),
        ),
    ),
}
UNDECLARED = {"elastic_belt", "knocks", "warming"}
"""What no effect of the catalogue is."""


@dataclass(frozen=True)
class IndependentDrive:
    """One drive with what is hidden in it.

    Attributes:
        kind: Its kind.
        hidden: Names of the effects.
        numbers: Parameters of `drive.c`.
        believed_inertia: The owner's number.
        believed_viscous: The owner's number.
    """

    kind: str
    hidden: tuple[str, ...]
    numbers: Mapping[str, float]
    believed_inertia: float
    believed_viscous: float


def draw(kind: str, case: int, seed: int) -> IndependentDrive:
    """The drive of a case of a kind, by chance."""
    k, rng = KINDS[kind], np.random.default_rng([seed, case, *kind.encode()])
    inertia = k.inertia * rng.uniform(0.7, 1.4)
    viscous = inertia / (k.settling_s * rng.uniform(0.7, 1.4))
    speed = k.travel * 2.0 * math.pi * k.speed_Hz
    effort = inertia * speed * 2.0 * math.pi * k.speed_Hz + viscous * speed
    band = 2.0 * math.pi * rng.uniform(5.0, 8.0)
    p = {
        "inertia": inertia * (1.0 - k.load_share),
        "load_inertia": inertia * k.load_share,
        "viscous": viscous * (1.0 - (share := k.load_share * rng.uniform(0.5, 1.0))),
        "load_viscous": viscous * share,
        "kp": inertia * band**2,
        "kd": 1.4 * inertia * band,
        "ki": 0.3 * inertia * band**3 if rng.random() < 0.5 else 0.0,
        "slow": 3e-3 * speed,
    }
    for name in k.hidden[case]:
        p |= EFFECTS[name](Chance(inertia, k.travel, speed, effort, rng))
    believed = inertia * rng.uniform(0.92, 1.08), viscous * rng.uniform(0.8, 1.2)
    return IndependentDrive(kind, k.hidden[case], p, *believed)


class Chance(NamedTuple):
    """Usual sizes of a drive, and random numbers."""

    inertia: float
    travel: float
    speed: float
    effort: float
    rng: np.random.Generator

    def between(self, low: float, high: float) -> float:
        """A number between two."""
        return float(self.rng.uniform(low, high))


def _dry(c: Chance) -> dict[str, float]:
    return {"dry": c.effort * c.between(0.1, 0.25), "bristle": 2e-6 * c.travel}


def _stribeck(c: Chance) -> dict[str, float]:
    dry = _dry(c)
    excess = dry["dry"] * c.between(0.5, 0.9)
    return dry | {"dry_excess": excess, "stribeck_speed": c.speed * c.between(0.03, 0.1)}


def _dahl(c: Chance) -> dict[str, float]:
    dry = c.effort * c.between(0.15, 0.3)
    return {"dry": dry, "bristle": c.travel * c.between(0.005, 0.02), "bristle_damping": 0.02}


def _ripple(c: Chance) -> dict[str, float]:
    order = float(c.rng.choice([4, 6, 8, 12]))
    size = c.effort * c.between(0.1, 0.2)
    return {"ripple1": size, "order1": order, "phase1": c.between(-3.0, 3.0)}


def _backlash(c: Chance) -> dict[str, float]:
    stiffness = c.effort / (2e-5 * c.travel)
    damping = 0.5 * math.sqrt(c.inertia * stiffness)
    return {
        "play": c.travel * c.between(0.001, 0.003),
        "stiffness": stiffness,
        "damping": damping,
    }


def _belt(c: Chance) -> dict[str, float]:
    stiffness = 0.24 * c.inertia * (2.0 * math.pi * c.between(9.0, 16.0)) ** 2
    return {"stiffness": stiffness, "damping": 0.02 * math.sqrt(stiffness * c.inertia)}


def _gravity(c: Chance) -> dict[str, float]:
    return {"gravity": c.effort * c.between(0.4, 1.2), "gravity_angle": c.between(-3.0, 3.0)}


def _warming(c: Chance) -> dict[str, float]:
    dry = {"dry": c.effort * c.between(0.2, 0.3), "bristle": 2e-6 * c.travel}
    return dry | {"warming": -c.between(0.6, 0.8), "warming_s": c.between(3.0, 6.0)}


EFFECTS: dict[str, Callable[[Chance], dict[str, float]]] = {
    "backlash": _backlash,
    "bent_viscous_friction": lambda c: {"quadratic": c.effort / c.speed**2 * c.between(0.15, 0.4)},
    "coulomb_friction": _dry,
    "current_lag": lambda c: {"lag": c.between(0.003, 0.006)},
    "current_saturation": lambda c: {"limit": c.effort * c.between(0.6, 0.8), "ki": 0.0},
    "dahl_hysteresis": _dahl,
    "dead_time": lambda c: {"dead_time": c.between(0.003, 0.006)},
    "directional_friction": lambda c: {"one_way": c.effort / c.speed * c.between(0.15, 0.4)},
    "elastic_belt": _belt,
    "knocks": lambda c: {"knock": c.effort * c.between(1.0, 2.0)},
    "link_gravity": _gravity,
    "load_friction": lambda c: {"gear_share": c.between(0.08, 0.2)},
    "stribeck_friction": _stribeck,
    "torque_ripple": _ripple,
    "warming": _warming,
}
"""Parameters of `drive.c` of each effect."""


@cache
def _names() -> tuple[str, ...]:
    library = _library()
    library.machine_parameters.restype = ctypes.c_char_p
    return tuple(library.machine_parameters().decode().split())


def _library() -> ctypes.CDLL:
    return compiled(Path(__file__).with_name("drive.c"))


class DriveInputs(NamedTuple):
    """What goes into a drive, columns of one value per sample."""

    reference: Column
    disturbance: Column
    reading_noise: Column


def run(
    numbers: Mapping[str, float], rate_Hz: float, inputs: DriveInputs
) -> tuple[Column, Column]:
    """Command and position read of a drive, one value per sample."""
    p = np.array([numbers.get(name, OFF.get(name, 0.0)) for name in _names()])
    columns = [np.ascontiguousarray(c, np.float64) for c in inputs]
    command, position = (np.empty(inputs.reference.size) for _ in range(2))
    pointers = [c.ctypes.data_as(ctypes.c_void_p) for c in (p, *columns, command, position)]
    substeps = round(1.0 / (rate_Hz * SUBSTEP_s))
    step_s = ctypes.c_double(1.0 / (rate_Hz * substeps))
    samples = ctypes.c_long(inputs.reference.size)
    _library().drive_run(pointers[0], samples, ctypes.c_long(substeps), step_s, *pointers[1:])
    return command, position
