"""A cable that goes on stretching."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class CableCreep(Effect):
    """A cable that goes on stretching under load: the standard linear solid.

        T = l - e,    tau e' = c T - e

    l is the tension of the linear law, e what the slow stretch takes off it: in the end the cable
    gives 1 + c times as much as at once. At the start it has settled.

    Attributes:
        share: Slow stretch c per quick stretch.
        time_s: Time constant tau of the slow stretch, s.
    """

    name: ClassVar[str] = "cable_creep"
    title: ClassVar[str] = "creep of the cable"
    appearance: ClassVar[str] = (
        "after a step the angle goes on moving for long while the tension is held, "
        "in the direction of the step"
    )
    port: ClassVar[Port] = Port.CABLE
    states: ClassVar[int] = 1

    share: float = parameter(0.1, low=0.0, high=2.0, unit="", neutral=0.0)
    time_s: float = parameter(0.3, low=0.01, high=100.0, unit="s")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Exact propagation over a substep at held l; while taut e -> c l/(1 + c)."""
        rate = (1.0 + p.share) / p.time_s
        return {"settled": p.share / (1.0 + p.share), "kept": ca.exp(-rate * reel.substep_s)}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the span is in the numbers prepared
    ) -> tuple[Signal, Signal]:
        """The tension left."""
        goal = p.settled * ca.fmax(signal, state)  # with T = max(0, l - e), T + e is max(l, e)
        return goal + (state - goal) * p.kept, signal - state

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the settled stretch
        signal: Signal,
        site: Site,  # noqa: ARG004  the same at any angle
    ) -> tuple[Signal, Signal]:
        """The slow stretch at its end."""
        stretch = p.share * signal
        return stretch, signal + stretch
