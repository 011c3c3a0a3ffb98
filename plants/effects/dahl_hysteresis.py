"""Friction that is elastic before it slips."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects.bristles import both_bent
from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class DahlHysteresis(Effect):
    """Friction built up over a small angle, as by bristles that bend before they slip (Dahl 1968).

        tau = -F (z_1 + z_2)/2,    dz_n/dtheta = (sign(omega) - z_n)/d_n,    z_n = 0 at the start
        d_1 = d,    d_2 = d/s

    Bearings and seals give way bit by bit, over lengths that are spread (Al-Bender, Lampaert &
    Swevers 2005); Dahl's own law has one length, s = 1. The torque is that of the mean z over a
    substep.

    Attributes:
        torque_Nm: Size F of the friction once it slips, N m.
        presliding_rad: Angle d over which it builds up, rad.
        spread: Factor s by which half of it builds up sooner.
    """

    name: ClassVar[str] = "dahl_hysteresis"
    title: ClassVar[str] = "Dahl hysteresis of the drum"
    appearance: ClassVar[str] = (
        "after each reversal current and tension drift apart over a small angle, "
        "so that small loops are narrower than large ones"
    )
    port: ClassVar[Port] = Port.DRUM
    states: ClassVar[int] = 2
    resists: ClassVar[bool] = True

    torque_Nm: float = parameter(0.02, low=0.0, high=1e4, unit="N m", neutral=0.0)
    presliding_rad: float = parameter(2e-3, low=1e-7, high=10.0, unit="rad")
    # At 1 it acts as the length does: a fit begins beside it.
    spread: float = parameter(1.0, low=1.0, high=100.0, unit="", begun=4.0)

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Half the velocity that friction takes off in a substep; lengths per velocity."""
        bend = reel.substep_s / p.presliding_rad
        return {
            "slowing": 0.5 * p.torque_Nm / reel.torque_per_velocity,
            "bend_1": bend,
            "bend_2": bend * p.spread,
        }

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  friction does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The mean torque of the bristles over the substep."""
        bent = both_bent(state, site, p.slowing, (p.bend_1, p.bend_2))
        return bent.after, -p.torque_Nm * bent.held
