"""A curved gauge."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class GaugeNonlinearity(Effect):
    """A gauge whose curve is bent: `y = T + c T^2`, a cantilever's second-order calibration curve.

    Attributes:
        curvature_per_N: The curvature c, 1/N; the curve rises up to a tension of -1/(2 c).
    """

    name: ClassVar[str] = "gauge_nonlinearity"
    title: ClassVar[str] = "nonlinearity of the gauge"
    appearance: ClassVar[str] = (
        "tension read against current is bent while angle against current is straight; "
        "the loop's gain depends on the tension level"
    )
    port: ClassVar[Port] = Port.GAUGE

    curvature_per_N: float = parameter(1e-3, low=-0.01, high=0.02, unit="1/N", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the curve is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension read."""
        return state, signal * (1.0 + p.curvature_per_N * signal)

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the curve is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension that reads so, on the rising part of the curve."""
        root = ca.sqrt(ca.fmax(1.0 + 4.0 * p.curvature_per_N * signal, 0.0))
        return state, 2.0 * signal / (1.0 + root)
