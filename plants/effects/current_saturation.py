"""A current limit."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class CurrentSaturation(Effect):
    """A current limit below the reel's own, of which the controller does not know.

        i = max(-i_max, min(u, i_max))

    Attributes:
        limit_A: Greatest size i_max of the current, A.
    """

    name: ClassVar[str] = "current_saturation"
    title: ClassVar[str] = "current limit of the drive"
    appearance: ClassVar[str] = (
        "tension stays flat above a level however much is commanded, and the integral winds up; "
        "small steps show nothing"
    )
    port: ClassVar[Port] = Port.ACTUATOR

    limit_A: float = parameter(1.5, low=1e-3, high=1e6, unit="A", neutral=1e6)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the limit is the same at all times
    ) -> tuple[Signal, Signal]:
        """The current within the limit."""
        return state, ca.fmin(ca.fmax(signal, -p.limit_A), p.limit_A)

    @staticmethod
    def rest(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The current wanted, or as much of it as there is."""
        return CurrentSaturation.respond(p, state, signal, site)
