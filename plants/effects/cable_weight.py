"""A cable heavier than the reel's own."""

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, si
from plants.effects.remedy import Place, Remedy

TINY_N3 = 1e-30
"""Keeps the third root differentiable where nothing is added."""


@dataclass(frozen=True)
class CableWeight(Effect):
    """More weight on the cable than the reel's linear law has, and its sag at any tension.

        R theta = T/k - q/T^2 + q/T_0^2,    q = ((w + dw)^2 - w^2) L^3/24,    w = mu g

    The last two terms are the length that the parabola's sag takes up (Irvine 1981), beyond that
    of the reel's own weight w at the preload T_0; the law's slope there is Ernst's. The root is
    computed in each substep by one step of Newton's method, extrapolated from the last two. Such a
    cable does not go slack. A cable swings besides: of four hidden machines two have an inertia
    1.1 % off. Where the reel models its own weight at any tension, all of it is in
    that law, and nothing is done here.

    Attributes:
        density_kg_m: Mass dmu added per length, kg/m.
    """

    name = "cable_weight"
    title = "weight of the cable"
    appearance = (
        "the cable is softer at low tension, the more so the longer it is, "
        "and the resonance falls with the tension"
    )
    excitation = "slow ramps at low tension on a long cable"
    known_apart = True
    port = Port.CABLE
    states = 2
    by_tension = True
    form_error = 0.005
    plain_remedies = (
        Remedy(
            Place.LOOP,
            "take the whole cable's weight, the model's and this, off the gauge's reading "
            "(compensation.gravity)",
            harm="needs the height of the far end above the reel",
        ),
    )

    density_kg_m: float = parameter(
        0.03,
        low=0.0,
        unit="kg/m",
        neutral=0.0,
        start=Share(0.03, "sagging_kg_m"),
        between=(Share(0.0), Share(0.5, "sagging_kg_m")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        sag = 9.81 * p.density_kg_m * plant.length_m**2 / (8.0 * plant.tension_N)
        place = f"on {si(plant.length_m, 'm')} at {si(plant.tension_N, 'N')}"
        seen = "" if math.isnan(sag) else f": {place} it sags {si(sag, 'm')} more"
        return (
            f"has a cable {1e3 * p.density_kg_m:.3g} g/m heavier than the model's{seen}, and is "
            "softer at low tension"
        )

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        """The weight added, for a reel whose own weight sags at any tension."""
        return {"added_density_kg_m": vars(reel).get("added_density_kg_m", 0.0) + p.density_kg_m}

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The constant k q in N^3, its third root, and k q/T_0^2."""
        density = reel.cable_density_kg_m
        weights = (density + p.density_kg_m) ** 2 - density**2
        q = weights * reel.gravity_m_s2**2 * reel.cable_length_m**3 / 24.0
        cube = q * reel.stiffness_N_m + TINY_N3
        return {
            "twice": 2.0 * cube,
            "thrice": 3.0 * cube,
            "root": cube ** (1.0 / 3.0),
            "shift": cube / reel.preload_N**2,
            "done": vars(reel).get("sags_in_full", 0.0),
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The root T of T - s - kq/T^2, which is concave: Newton's steps end below it."""
        s = signal - p.shift
        start = ca.fmax(2.0 * state[0] - state[1], 0.125 * state[0])
        square = start * start
        tension = (start / (start * square + p.twice)) * (square * s + p.thrice)
        # The root lies above s, and stays above zero in however fast a fall.
        tension = ca.fmax(ca.fmax(tension, s), ca.fmin(0.125 * start, p.root))
        return ca.vertcat(tension, state[0]), tension + p.done * (signal - tension)

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        tension = ca.fmax(signal, 0.1 * p.root)
        linear = tension - 0.5 * p.twice / tension**2 + p.shift
        return ca.vertcat(tension, tension), linear + p.done * (signal - linear)
