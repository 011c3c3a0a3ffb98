"""A shifted zero of the gauge."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class GaugeOffset(Effect):
    """A gauge that reads the same amount too much at any tension: `y = T + T_0`.

    Attributes:
        offset_N: The amount T_0, N.
    """

    name: ClassVar[str] = "gauge_offset"
    title: ClassVar[str] = "zero offset of the gauge"
    appearance: ClassVar[str] = (
        "tension read and current differ by a constant that no motion changes, "
        "and the cable is slack at a reading other than zero"
    )
    port: ClassVar[Port] = Port.GAUGE

    offset_N: float = parameter(0.5, low=-20.0, high=20.0, unit="N", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the offset is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension read."""
        return state, signal + p.offset_N

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the offset is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension that reads so."""
        return state, signal - p.offset_N
