"""Friction that is elastic before it slips."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class DahlHysteresis(Effect):
    """Friction built up over a small angle, as by bristles that bend before they slip (Dahl 1968).

        tau = -F z,    dz/dtheta = (sign(omega) - z)/d,    z = 0 at the start

    z is propagated exactly over the angle turned in a substep, the torque is its mean. The angle
    is that of the substep's mean velocity with friction's own answer in it, solved to first order,
    so that stiff bristles do not make the drum ring.

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

    torque_Nm: float = parameter(0.02, low=0.0, high=2.0, unit="N m", neutral=0.0)
    presliding_rad: float = parameter(2e-3, low=1e-4, high=0.2, unit="rad")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Share of the bristles' length per velocity, s/rad."""
        return {"bend_s_rad": reel.substep_s / p.presliding_rad}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  friction does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The mean torque of the bristles over the substep."""
        # With the torque F z held, the mean velocity would be `unheld`; F z/2 counts in a mean.
        half = 0.5 * p.torque_Nm
        unheld = 0.5 * (
            (site.start_velocity_rad_s + site.velocity_rad_s) * site.torque_per_velocity
        ) - (half * state)
        direction = ca.sign(unheld)
        stiffness = half * p.bend_s_rad * (1.0 - direction * state)
        mean = unheld / (site.torque_per_velocity + 0.5 * stiffness)
        bent = direction + (state - direction) * ca.exp(-p.bend_s_rad * ca.fabs(mean))
        return bent, -half * (state + bent)
