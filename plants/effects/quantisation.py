"""A reading in steps."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

FINEST_N = 1e-12


@dataclass(frozen=True)
class Quantisation(Effect):
    """A gauge read in steps, as by a coarse converter: `y = q floor(T/q + 1/2)`.

    Attributes:
        step_N: The step q, N; the reel's own gauge has none.
    """

    name: ClassVar[str] = "quantisation"
    title: ClassVar[str] = "quantisation of the gauge"
    appearance: ClassVar[str] = (
        "the reading takes few values, and at rest jumps between two of them"
    )
    port: ClassVar[Port] = Port.GAUGE
    smooth: ClassVar[bool] = False

    step_N: float = parameter(0.1, low=0.0, high=5.0, unit="N", neutral=0.0)

    @staticmethod
    def prepare(
        p: SimpleNamespace,
        reel: SimpleNamespace,  # noqa: ARG004  a step is the same on any reel
    ) -> dict[str, Signal]:
        """The step, and steps per newton; a step of zero is taken as one too small to see."""
        step = ca.fmax(p.step_N, FINEST_N)
        return {"step": step, "per_N": 1.0 / step}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the steps are the same at all times
    ) -> tuple[Signal, Signal]:
        """The nearest step."""
        return state, p.step * ca.floor(signal * p.per_N + 0.5)
