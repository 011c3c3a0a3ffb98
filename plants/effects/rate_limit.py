"""A limit to how fast the current changes."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class RateLimit(Effect):
    """A current that cannot change faster than a rate: `|di/dt| <= r`.

    It ramps towards what is commanded. Over a sample of length h, what acts is its mean:

        i_end = i + e,    mean i = i_end - e |e|/(2 r h),    e = max(-r h, min(u - i, r h))

    Attributes:
        rate_A_per_s: Greatest size r of its rate of change, A/s.
    """

    name: ClassVar[str] = "rate_limit"
    title: ClassVar[str] = "rate limit of the drive"
    appearance: ClassVar[str] = (
        "large steps begin with a straight ramp of the tension and lag behind, "
        "small ones show nothing"
    )
    port: ClassVar[Port] = Port.ACTUATOR
    states: ClassVar[int] = 1

    rate_A_per_s: float = parameter(50.0, low=1e-3, high=1e12, unit="A/s", neutral=1e12)

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The current that is reached within the sample, and its mean on the way."""
        most = p.rate_A_per_s * site.span_s
        way = ca.fmin(ca.fmax(signal - state, -most), most)
        return state + way, state + way - way * ca.fabs(way) / (2.0 * most)

    @staticmethod
    def rest(
        p: SimpleNamespace,  # noqa: ARG004  at rest any rate will do
        state: Signal,  # noqa: ARG004  it is the current
        signal: Signal,
        site: Site,  # noqa: ARG004  the same anywhere
    ) -> tuple[Signal, Signal]:
        """The current held."""
        return signal, signal
