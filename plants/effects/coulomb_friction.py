"""Dry friction of constant size."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

TINY_Nm = 1e-30
"""Keeps a quotient finite where there is no friction."""


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Dry friction in the drum's bearings: `tau = -F sign(omega)`, and |tau| <= F at rest.

    The torque is held over a substep and chosen by the velocity the substep ends with (a proximal
    step, Moreau 1988): it is the torque that brings the drum to rest, cut at F. So it opposes the
    motion, sticks exactly, does not chatter and needs no smoothing. Where there is grease between
    the surfaces they creep instead of sticking, `tau = -F omega/omega_c` up to F.

    Attributes:
        torque_Nm: Size F of the friction, N m.
        creep_rad_s: Velocity omega_c up to which they creep, rad/s; 0 where they stick.
    """

    name: ClassVar[str] = "coulomb_friction"
    title: ClassVar[str] = "Coulomb friction of the drum"
    appearance: ClassVar[str] = (
        "current and tension differ by a constant whose sign is that of the velocity; "
        "small steps stop short of the setpoint"
    )
    port: ClassVar[Port] = Port.DRUM
    resists: ClassVar[bool] = True

    torque_Nm: float = parameter(0.02, low=0.0, high=1e4, unit="N m", neutral=0.0)
    creep_rad_s: float = parameter(0.0, low=0.0, high=1e3, unit="rad/s", begun=0.0)

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Torque that takes off a unit of velocity, of what the surfaces creep with the less."""
        mass = reel.torque_per_velocity
        return {"stopping": mass * p.torque_Nm / (p.torque_Nm + mass * p.creep_rad_s + TINY_Nm)}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  friction does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The torque that would end the substep at rest, or at what they creep, no more than F."""
        stopping = -site.velocity_rad_s * p.stopping
        return state, ca.fmin(ca.fmax(stopping, -p.torque_Nm), p.torque_Nm)
