"""Dry friction that is largest at rest."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

SIXTEENTHS = 16.0
FURTHEST = 2.5
"""Sixteenth of the exponent beyond which nothing is left of the exponential."""


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Dry friction that falls as the drum gathers speed, the steady curve (10).

        tau = -(F_c + F_e exp(-(omega/v_s)^2)) sign(omega),    F_e = f_s - f_c

    Its size is taken at the substep's start; within it the friction is that of
    `CoulombFriction`, which sticks exactly. The exponential is the sixteenth power of its (2, 2)
    Pade approximation at a sixteenth, right to 1e-6: four multiplications cost a trial less than a
    call of exp in each substep. `estune.reel.friction.StribeckFriction` is the same curve fed
    forward.

    Attributes:
        coulomb_Nm: Size F_c at speed, N m.
        excess_Nm: What static friction F_e adds to it at rest, N m.
        stribeck_rad_s: Velocity v_s over which it fades, rad/s.
    """

    name: ClassVar[str] = "stribeck_friction"
    title: ClassVar[str] = "Stribeck friction of the drum"
    appearance: ClassVar[str] = (
        "like Coulomb friction, but the drum breaks away with a jerk and, moved slowly, "
        "sticks and slips"
    )
    port: ClassVar[Port] = Port.DRUM
    resists: ClassVar[bool] = True

    coulomb_Nm: float = parameter(0.02, low=0.0, high=2.0, unit="N m", neutral=0.0)
    excess_Nm: float = parameter(0.01, low=0.0, high=2.0, unit="N m", neutral=0.0)
    stribeck_rad_s: float = parameter(0.5, low=0.01, high=50.0, unit="rad/s")

    @staticmethod
    def prepare(
        p: SimpleNamespace,
        reel: SimpleNamespace,  # noqa: ARG004  it is the same in any reel
    ) -> dict[str, Signal]:
        """Factor of the velocity's square, s2/rad2."""
        return {"per_square": 1.0 / (SIXTEENTHS * p.stribeck_rad_s**2)}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  friction does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The torque that would end the substep at rest, no larger than the friction."""
        t = ca.fmin(p.per_square * site.start_velocity_rad_s**2, FURTHEST)
        even, odd = 1.0 + (1.0 / 12.0) * (t * t), 0.5 * t
        sixteenth = (even - odd) / (even + odd)
        fade = (((sixteenth**2) ** 2) ** 2) ** 2
        size = p.coulomb_Nm + p.excess_Nm * fade
        stopping = -site.velocity_rad_s * site.torque_per_velocity
        return state, ca.fmin(ca.fmax(stopping, -size), size)
