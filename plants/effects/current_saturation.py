"""A current limit."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, NEVER, Role, Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, in_loop, limit

TINY = 1e-12


@dataclass(frozen=True)
class CurrentSaturation(Effect):
    """A current limit below the reel's own, of which the controller does not know.

        |i| = |u| - d^2/(4 h),    d = max(0, |u| - i_max + h) up to |u| = i_max + h
        |i| = i_max               beyond,    h = b i_max

    An amplifier that runs out of voltage bends before it is flat: a parabola leads from the
    straight to the limit. The least b is a sharp corner; at none at all a fit would not see how
    the current changes with it.

    Attributes:
        limit_A: Greatest size i_max of the current, A.
        bend: Half the width of the bend, b, relative to the limit.
    """

    name = "current_saturation"
    title = "current limit of the drive"
    appearance = (
        "the measurement stays flat above a level however much is commanded, and the "
        "integral winds up; small steps show nothing"
    )
    excitation = "large steps"
    port = Port.ACTUATOR

    limit_A: float = parameter(
        1.5,
        low=ABOVE_ZERO,
        unit="A",
        neutral=NEVER,
        role=Role.LIMIT,
        between=(Share(1e-3, "current_max_A"), Share(10.0, "current_max_A")),
    )
    bend: float = parameter(0.02, low=1e-3, high=0.9)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has a drive that gives no more than {plant.current(p.limit_A)}, however much is "
            "commanded; beyond it the controller's integral winds up"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        harm = "told too low, it withholds tension: ask for 97 % of it at most"
        # The command from which on it gives no more: told the limit alone, it would keep the
        # bend's last part back.
        table = "current_limit", {"limit_A": (1.0 + p.bend) * p.limit_A}
        title = "tell the anti-windup the current that the drive really gives"
        return (
            in_loop(plant, title, "limit_A", table, harm),
            limit("beyond it no gains reach a tension"),
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        half = p.bend * p.limit_A
        size = ca.fmin(ca.fabs(signal), p.limit_A + half)
        into = ca.fmax(size - p.limit_A + half, 0.0)
        return state, ca.sign(signal) * (size - into * into / (4.0 * half + TINY))

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The current commanded for one that flows, or the least for as much as there is."""
        half = p.bend * p.limit_A
        size = ca.fmin(ca.fabs(signal), p.limit_A)
        beyond = ca.fmax(size - p.limit_A + half, 0.0)
        # into^2/(4 half) = into - beyond
        into = 2.0 * half * (1.0 - ca.sqrt(ca.fmax(1.0 - beyond / (half + TINY), TINY)))
        return state, ca.sign(signal) * (size - beyond + into)
