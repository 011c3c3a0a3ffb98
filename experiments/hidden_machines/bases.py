"""Machines as their owner believes them to be, and as they are."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

Kind = Literal["reel", "unloaded", "stage"]
GRAVITY = 9.81
CURRENT_LOOP_s = (6e-5, 1.2e-4)
"""Least and greatest lag of the current loop of a sound drive, of which no owner knows."""


@dataclass(frozen=True)
class Base:
    """A machine without any hidden effect; units as in the names.

    `gain` and `push_N` are the drive's, `zero_N` the gauge's: none is known to the owner. Nor is
    what every gauge has a little of: its reading lags the load by `loop_N`, either way, built up
    over `loop_width_N`.
    """

    kind: Kind = "reel"
    radius_m: float = 0.025
    inertia_kg_m2: float = 2.0e-3
    viscous_Nms: float = 0.010
    viscous_per_length_Ns: float = 0.015
    structure_N_m: float = 20e3
    EA_N: float = 10e3
    density_kg_m: float = 0.007
    torque_Nm_A: float = 0.5
    limit_A: float = 6.0
    gauge_Hz: float = 290.0
    gauge_damping: float = 0.03
    noise_N: float = 0.04
    encoder_counts: float = 8192.0
    rate_Hz: float = 632.0
    dead_time_s: float = 1.0 / 632.0
    gain: float = 1.0
    push_N: float = 0.0
    zero_N: float = 0.0
    loop_N: float = 0.0
    loop_width_N: float = 2.0

    @property
    def newtons_per_ampere(self) -> float:
        """Force at the rim per current, as the owner believes."""
        return self.torque_Nm_A / self.radius_m

    def stiffness(self, length_m: float) -> float:
        """Of structure and cable in series, N/m."""
        return 1.0 / (1.0 / self.structure_N_m + length_m / self.EA_N)

    def machine(self, length_m: float | None) -> dict[str, float]:
        """In the coordinates of `equations.h`: forces at the rim, metres of cable."""
        R = self.radius_m
        made = {
            "mass": self.inertia_kg_m2 / R**2,
            "drag": self.viscous_Nms / R**2,
            "gain": self.gain,
            "push": self.push_N,
            "delay": self.dead_time_s,
            "radius": R,
            "encoder_step": 2.0 * np.pi / self.encoder_counts,
            "command_limit": self.limit_A * self.newtons_per_ampere,
        }
        if length_m is None:
            return made | {"unloaded": 1.0}
        return made | {
            "drag": (self.viscous_Nms + self.viscous_per_length_Ns * length_m) / R**2,
            "stiffness": self.stiffness(length_m),
            "sag": (self.density_kg_m * GRAVITY) ** 2 * length_m**3 / 24.0,
            "gauge_rate": 2.0 * np.pi * self.gauge_Hz,
            "gauge_damping": self.gauge_damping,
            "gauge_loop": -self.loop_N,
            "gauge_loop_width": self.loop_width_N,
        }

    def given(self) -> dict[str, Any]:
        """The owner's parameters, named as the owner's model names them."""
        own: dict[str, Any] = {
            "drum_radius_m": self.radius_m,
            "drum_inertia_kg_m2": self.inertia_kg_m2,
            "viscous_friction_Nms": self.viscous_Nms,
            "torque_constant_Nm_A": self.torque_Nm_A,
            "current_limit_A": self.limit_A,
            "encoder_counts": self.encoder_counts,
            "sampling_Hz": self.rate_Hz,
            "dead_time_s": self.dead_time_s,
        }
        if self.kind != "reel":
            return own
        return own | {
            "viscous_friction_per_length_Ns": self.viscous_per_length_Ns,
            "structure_stiffness_N_m": self.structure_N_m,
            "cable_EA_N": self.EA_N,
            "cable_density_kg_m": self.density_kg_m,
            "gauge_Hz": self.gauge_Hz,
            "gauge_damping": self.gauge_damping,
            "gauge_noise_N": self.noise_N,
        }


REEL = Base()
SOFT = replace(REEL, EA_N=220.0)
"""A reel with an elastic cord, whose drum turns far."""
UNLOADED = replace(REEL, kind="unloaded", density_kg_m=0.0)
STAGE = Base(
    kind="stage",
    radius_m=1.0,  # so that angles are metres and torques are forces
    inertia_kg_m2=95.0,
    viscous_Nms=200.0,
    torque_Nm_A=35.0,
    limit_A=10.0,
    encoder_counts=2.0 * np.pi / 2e-6,
    rate_Hz=1000.0,
    dead_time_s=0.001,
)
"""A linear stage on a screw."""


def actual(rng: np.random.Generator, base: Base, *, wrong: bool) -> Base:
    """The machine as it is: off by some per cent, or by a fifth to a third where `wrong`."""

    def off(share: float) -> float:
        if wrong:
            return float(rng.choice([-1, 1]) * rng.uniform(0.2, 0.3) + 1.0)
        return 1.0 + rng.uniform(-share, share)

    forces = 0.3 * base.newtons_per_ampere / REEL.newtons_per_ampere
    return replace(
        base,
        inertia_kg_m2=base.inertia_kg_m2 * off(0.08),
        viscous_Nms=base.viscous_Nms * off(0.2),
        viscous_per_length_Ns=base.viscous_per_length_Ns * (1.0 + rng.uniform(-0.2, 0.2)),
        structure_N_m=base.structure_N_m * off(0.08),
        EA_N=base.EA_N * off(0.08),
        gauge_Hz=base.gauge_Hz * (1.0 + rng.uniform(-0.005, 0.005)),
        gauge_damping=base.gauge_damping * (1.0 + rng.uniform(-0.1, 0.1)),
        noise_N=base.noise_N * rng.uniform(0.75, 1.25),
        gain=1.0 + rng.uniform(-0.05, 0.05) * (2.0 if wrong else 1.0),
        push_N=float(rng.uniform(-forces, forces)),
        zero_N=float(rng.uniform(-0.3, 0.3)),
        **_loop(rng),
    )


def _loop(rng: np.random.Generator) -> dict[str, Any]:
    """Hysteresis of half a thousandth of the range, as good load cells have it."""
    return {"loop_N": rng.uniform(0.012, 0.024), "loop_width_N": rng.uniform(1.0, 4.0)}


def as_believed(rng: np.random.Generator, base: Base) -> Base:
    """A machine that is as its owner believes, but for the noise."""
    return replace(base, noise_N=base.noise_N * rng.uniform(0.75, 1.25), **_loop(rng))


def facts(base: Base) -> dict[str, float]:
    """True values that a scorer may compare fitted calibrations with.

    The offsets of drive and gauge cannot be told apart while the cable is taut, nor gain and
    inertia where there is no gauge.
    """
    if base.kind != "reel":
        return {}
    return {"drum_inertia_kg_m2": base.inertia_kg_m2, "torque_gain": base.gain}
