"""A cable that stiffens under tension."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class CableStiffening(Effect):
    """A cable whose fibres straighten as it is pulled: `T = l + c l^2`, l that of the linear law.

    Attributes:
        stiffening_per_N: The coefficient c, 1/N.
    """

    name: ClassVar[str] = "cable_stiffening"
    title: ClassVar[str] = "stiffening of the cable"
    appearance: ClassVar[str] = (
        "tension against angle is bent upward while tension against current is straight; "
        "the resonance rises with the tension"
    )
    port: ClassVar[Port] = Port.CABLE

    stiffening_per_N: float = parameter(5e-3, low=0.0, high=0.1, unit="1/N", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension; a slack cable stays slack."""
        return state, signal * (1.0 + p.stiffening_per_N * ca.fmax(signal, 0.0))

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The linear law's tension."""
        root = ca.sqrt(1.0 + 4.0 * p.stiffening_per_N * ca.fmax(signal, 0.0))
        return state, 2.0 * signal / (1.0 + root)
