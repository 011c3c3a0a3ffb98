"""Slack that is taken up before the cable holds."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

TINY_N = 1e-30
"""Slack that no tension feels, so that none at zero tension is not 0/0."""


@dataclass(frozen=True)
class CableSlack(Effect):
    """Extra length taken up before the cable holds, as of loose windings that bed in.

        T = l^2/(4 k s)  up to l = 2 k s,    T = l - k s  above,    l = k R theta

    The reel's own cable never pushes and holds at once; this one has a toe, over which it gets as
    stiff as ever.

    Attributes:
        slack_m: The slack s, m.
    """

    name: ClassVar[str] = "cable_slack"
    title: ClassVar[str] = "slack of the cable"
    appearance: ClassVar[str] = (
        "near zero tension the angle moves far for little tension; "
        "well above, the cable is as stiff as ever"
    )
    port: ClassVar[Port] = Port.CABLE

    slack_m: float = parameter(1e-3, low=0.0, high=0.05, unit="m", neutral=0.0)

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The slack as a tension of the linear law, N."""
        slack = p.slack_m * reel.stiffness_N_m + TINY_N
        return {"slack_N": slack, "bend_per_N": 0.25 / slack}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension; a slack cable stays slack."""
        pulled = ca.fmax(signal, 0.0)
        beyond_toe = signal > 2.0 * p.slack_N
        toe = (p.bend_per_N * pulled) * pulled
        return state, ca.if_else(beyond_toe, signal - p.slack_N, toe)

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The linear law's tension."""
        toe = ca.sqrt(4.0 * p.slack_N * ca.fmax(signal, 0.0))
        return state, ca.if_else(signal > p.slack_N, signal + p.slack_N, toe)
