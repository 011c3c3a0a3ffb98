"""Dry friction of constant size."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, friction_feed_forward

TINY_Nm = 1e-30
"""Keeps a quotient finite where there is no friction."""


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Dry friction in the drum's bearings: `tau = -F sign(omega)`, and `|tau| <= F` at rest.

    The torque is held over a substep and chosen by the velocity the substep ends with (a proximal
    step, Moreau 1988): it is the torque that brings the drum to rest, cut at F. So it opposes the
    motion, sticks exactly, does not chatter and needs no smoothing. Where there is grease between
    the surfaces they creep instead of sticking, `tau = -F omega/omega_c` up to F.

    Attributes:
        torque_Nm: Size F of the friction, N m; without a gauge by the torque constant given, as
            every torque is then.
        creep_rad_s: Velocity omega_c up to which they creep, rad/s; 0 where they stick.
    """

    name = "coulomb_friction"
    title = "Coulomb friction"
    appearance = (
        "motion takes a constant effort more, whatever its velocity; small steps stop short "
        "of the setpoint"
    )
    excitation = "slow reversals"
    family = "dry friction"
    port = Port.DRUM
    resists = True

    torque_Nm: float = parameter(0.02, low=0.0, unit="N m", neutral=0.0)
    creep_rad_s: float = parameter(0.0, low=0.0, unit="rad/s", start=0.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has dry friction{plant.at_drum}: {plant.torque(p.torque_Nm)} against the motion, "
            "at any speed. A smaller change of the command causes no motion"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        return friction_feed_forward(
            plant,
            "torque_Nm",
            {"coulomb_Nm": p.torque_Nm, "static_Nm": p.torque_Nm},
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Torque that takes off a unit of velocity, of what the surfaces creep with the less."""
        mass = reel.torque_per_velocity
        return {"stopping": mass * p.torque_Nm / (p.torque_Nm + mass * p.creep_rad_s + TINY_Nm)}

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        """The torque that would end the substep at rest, or at what they creep, no more than F."""
        stopping = -site.velocity_rad_s * p.stopping
        return state, ca.fmin(ca.fmax(stopping, -p.torque_Nm), p.torque_Nm)
