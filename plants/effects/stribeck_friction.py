"""Dry friction that is largest at rest."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from plants.effects.bristles import PRESLIDING, both_bent
from plants.effects.dahl_hysteresis import DahlHysteresis
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, friction_feed_forward

SIXTEENTHS = 16.0
FURTHEST = 2.5
"""Sixteenth of the exponent beyond which nothing is left of the exponential."""


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Dry friction that falls as the drum gathers speed, the steady curve (10), on bristles.

        tau = -(F_c + F_e exp(-(omega/v_s)^2)) (z_1 + z_2)/2

    F_e is f_s - f_c. The size is taken at the substep's start; within it the bristles z are those
    of `DahlHysteresis`, stiff by default: dry friction is slightly elastic before it slips, and a
    rigid law would attribute that to another friction. The exponential is the
    sixteenth power of its (2, 2) Pade approximation at a sixteenth, right to 1e-6: four
    multiplications cost a trial less than a call of exp in each substep.
    `estune.reel.friction.StribeckFriction` is the same curve fed forward.

    Attributes:
        coulomb_Nm: Size F_c at speed, N m.
        excess_Nm: What static friction F_e adds to it at rest, N m.
        stribeck_rad_s: Velocity v_s over which it fades, rad/s.
        presliding_rad: Angle d over which it builds up, rad.
        spread: Factor s by which half of it builds up sooner.
    """

    name = "stribeck_friction"
    title = "Stribeck friction"
    appearance = (
        "like Coulomb friction, but motion begins with a jerk and, when slow, sticks and slips"
    )
    excitation = "slow reversals and fast motion"
    family = "dry friction"
    extends = DahlHysteresis
    inherits: ClassVar[Mapping[str, str]] = {
        "coulomb_Nm": "torque_Nm",
        "presliding_rad": "presliding_rad",
        "spread": "spread",
    }
    port = Port.DRUM
    states = 2
    resists = True
    form_error = 0.005

    # Friction that falls to nothing with speed is no dry friction.
    coulomb_Nm: float = parameter(
        0.02, low=0.0, unit="N m", neutral=0.0, least=(Share(0.2, "excess_Nm"),)
    )
    # Friction that hardly falls is as good as constant.
    excess_Nm: float = parameter(
        0.01, low=0.0, unit="N m", neutral=0.0, least=(Share(0.2, "coulomb_Nm"),)
    )
    stribeck_rad_s: float = parameter(
        0.5,
        low=ABOVE_ZERO,
        unit="rad/s",
        between=(Share(1e-4, "velocity_max_rad_s"), Share(2.0, "velocity_max_rad_s")),
    )
    presliding_rad: float = parameter(1e-5, low=ABOVE_ZERO, unit="rad", between=PRESLIDING)
    spread: float = parameter(1.0, low=1.0, high=100.0, start=4.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has dry friction that is largest at rest: {plant.torque(p.coulomb_Nm)} in motion "
            f"and {plant.torque(p.excess_Nm)} more at rest, which fades over "
            f"{plant.speed(p.stribeck_rad_s)}. It gives {plant.travel(p.presliding_rad)} before "
            "it slips; moved slowly, it sticks and slips"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        return friction_feed_forward(
            plant,
            "coulomb_Nm",
            {
                "coulomb_Nm": p.coulomb_Nm,
                "static_Nm": p.coulomb_Nm + p.excess_Nm,
                "stribeck_rad_s": p.stribeck_rad_s,
                "memory_rad": p.presliding_rad,
                "spread": p.spread,
            },
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Factor of the velocity's square, s2/rad2; what a torque slows; lengths per velocity."""
        bend = reel.substep_s / p.presliding_rad
        return {
            "per_square": 1.0 / (SIXTEENTHS * p.stribeck_rad_s**2),
            "slowing": 0.5 / reel.torque_per_velocity,
            "bend_1": bend,
            "bend_2": bend * p.spread,
        }

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        start = site.start_velocity_rad_s
        size = p.coulomb_Nm + p.excess_Nm * faded(p.per_square * start**2)
        bent = both_bent(state, site, size * p.slowing, (p.bend_1, p.bend_2))
        return bent.after, -size * bent.held


def faded(sixteenth: Signal) -> Signal:
    """Share of the excess that is left: exp of minus sixteen times the argument."""
    t = ca.fmin(sixteenth, FURTHEST)
    even, odd = 1.0 + (1.0 / 12.0) * (t * t), 0.5 * t
    root = (even - odd) / (even + odd)
    return (((root**2) ** 2) ** 2) ** 2
