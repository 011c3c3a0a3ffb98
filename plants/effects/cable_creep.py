"""Creep of the cable."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, Share, parameter
from plants.effects.plant_scale import PlantScale, share, si
from plants.effects.remedy import limit


@dataclass(frozen=True)
class CableCreep(Effect):
    """A cable that creeps under load: the standard linear solid.

        T = l - e,    tau e' = c T - e

    l is the tension of the linear law, e its reduction by the slow stretch: in the end the cable
    stretches 1 + c times as far as at once. At the start it has settled.

    Attributes:
        share: Slow stretch c per quick stretch.
        time_s: Time constant tau of the slow stretch, s.
    """

    name = "cable_creep"
    title = "creep of the cable"
    appearance = (
        "after a step the angle keeps moving for long while the tension is held, "
        "in the direction of the step"
    )
    excitation = "long holds after large steps"
    port = Port.CABLE
    states = 1
    plain_remedies = (
        limit("wait until the cable has crept, or pre-stretch it; gains change nothing"),
    )

    share: float = parameter(0.1, low=0.0, high=2.0, neutral=0.0)
    # Shorter than some samples it is stiffness, longer than the records it is another length.
    time_s: float = parameter(
        0.3,
        low=ABOVE_ZERO,
        unit="s",
        start=Share(2.0, "window_s"),
        between=(Share(6.0, "sample_s"), Share(10.0, "record_s")),
    )

    @classmethod
    def describe(cls, p: Values, _plant: PlantScale) -> str:
        return (
            f"has a cable that creeps: after each change it gives another {share(p.share)} of "
            f"what it gave at once, with a time constant of {si(p.time_s, 's')}"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Exact propagation over a substep at held l; while taut e -> c l/(1 + c)."""
        rate = (1.0 + p.share) / p.time_s
        return {"settled": p.share / (1.0 + p.share), "kept": ca.exp(-rate * reel.substep_s)}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        goal = p.settled * ca.fmax(signal, state)  # with T = max(0, l - e), T + e is max(l, e)
        return goal + (state - goal) * p.kept, signal - state

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        stretch = p.share * signal
        return stretch, signal + stretch
