"""Friction that is elastic before it slips."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.bristles import bent
from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class DahlHysteresis(Effect):
    """Friction built up over a small angle, as by bristles that bend before they slip (Dahl 1968).

        tau = -F z,    dz/dtheta = (sign(omega) - z)/d,    z = 0 at the start

    The torque is that of the mean z over a substep. The angle turned in it is that of the mean
    velocity with friction's own answer in it, solved to first order, so that stiff bristles do
    not make the drum ring.

    Attributes:
        torque_Nm: Size F of the friction once it slips, N m.
        presliding_rad: Angle d over which it builds up, rad.
    """

    name: ClassVar[str] = "dahl_hysteresis"
    title: ClassVar[str] = "Dahl hysteresis of the drum"
    appearance: ClassVar[str] = (
        "after each reversal current and tension drift apart over a small angle, "
        "so that small loops are narrower than large ones"
    )
    port: ClassVar[Port] = Port.DRUM
    states: ClassVar[int] = 1
    resists: ClassVar[bool] = True

    torque_Nm: float = parameter(0.02, low=0.0, high=1e4, unit="N m", neutral=0.0)
    presliding_rad: float = parameter(2e-3, low=1e-7, high=10.0, unit="rad")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Half the friction, the velocity it takes off in a substep, and lengths per velocity."""
        half = 0.5 * p.torque_Nm
        slowing, bend = half / reel.torque_per_velocity, reel.substep_s / p.presliding_rad
        return {"half": half, "slowing": slowing, "bend": bend, "grip": 0.5 * slowing * bend}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  friction does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The mean torque of the bristles over the substep."""
        # What the mean velocity would be if the bristles kept their torque.
        start = 0.5 * site.start_velocity_rad_s - p.slowing * state
        unheld = start + 0.5 * site.velocity_rad_s
        stiffness = p.grip * (1.0 - ca.sign(unheld) * state)
        further = bent(state, unheld * (p.bend / (1.0 + stiffness)))
        return state + further, -p.torque_Nm * state - p.half * further
