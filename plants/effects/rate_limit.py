"""A limit to how fast the current changes."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, NEVER, Role, Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import limit, workshop


@dataclass(frozen=True)
class RateLimit(Effect):
    """A current that cannot change faster than a rate: `|di/dt| <= r`.

    It ramps towards what is commanded. Over a sample of length h, what acts is its mean:

        i_end = i + e,    mean i = i_end - e |e|/(2 r h),    e = max(-r h, min(u - i, r h))

    Attributes:
        rate_A_per_s: Greatest size r of its rate of change, A/s.
    """

    name = "rate_limit"
    title = "rate limit of the drive"
    appearance = (
        "large steps begin with a straight ramp of the measurement and lag behind, small "
        "ones show nothing"
    )
    excitation = "large steps"
    port = Port.ACTUATOR
    states = 1
    plain_remedies = (
        limit("ask for no steeper setpoints than the drive's rate allows"),
        workshop("raise the rate limit of the amplifier"),
    )

    rate_A_per_s: float = parameter(
        50.0,
        low=ABOVE_ZERO,
        unit="A/s",
        neutral=NEVER,
        role=Role.LIMIT,
        between=(Share(1e-3, "current_rate_A_s"), Share(10.0, "current_rate_A_s")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            "has a drive whose current changes no faster than "
            f"{plant.current(p.rate_A_per_s, '/s')}: large steps become ramps, small ones pass"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The current that is reached within the sample, and its mean on the way."""
        most = p.rate_A_per_s * site.span_s
        way = ca.fmin(ca.fmax(signal - state, -most), most)
        return state + way, state + way - way * ca.fabs(way) / (2.0 * most)

    @staticmethod
    def rest(_p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        return signal, signal
