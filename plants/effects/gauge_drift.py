"""A zero of the gauge that wanders."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class GaugeDrift(Effect):
    """A gauge whose zero moves steadily, as with temperature: `y = T + r t`, t from the start.

    Attributes:
        rate_N_per_s: The rate r, N/s.
    """

    name: ClassVar[str] = "gauge_drift"
    title: ClassVar[str] = "drift of the gauge"
    appearance: ClassVar[str] = (
        "tension read and current move apart in proportion to the time, whatever the reel does; "
        "the first and last rest of a record disagree"
    )
    port: ClassVar[Port] = Port.GAUGE
    states: ClassVar[int] = 1

    rate_N_per_s: float = parameter(0.1, low=-10.0, high=10.0, unit="N/s", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The tension read; what is remembered is the drift."""
        return state + p.rate_N_per_s * site.span_s, signal + state
