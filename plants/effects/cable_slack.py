"""Slack that is taken up before the cable holds."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class CableSlack(Effect):
    """Extra length taken up before the cable holds, as of loose windings that bed in.

        R theta = T/k + s T/(T + T_s)

    The reel's own cable never pushes and holds at once; this one has a toe: half of the slack s is
    taken up at the tension T_s, all of it at tensions far above.

    Attributes:
        slack_m: The slack s, m.
        bedding_N: Tension T_s at which half of it is taken up, N.
    """

    name: ClassVar[str] = "cable_slack"
    title: ClassVar[str] = "slack of the cable"
    appearance: ClassVar[str] = (
        "near zero tension the angle moves far for little tension; "
        "well above, the cable is as stiff as ever"
    )
    port: ClassVar[Port] = Port.CABLE

    slack_m: float = parameter(1e-3, low=0.0, high=0.05, unit="m", neutral=0.0)
    bedding_N: float = parameter(3.0, low=0.1, high=50.0, unit="N")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The slack as a tension of the linear law, N."""
        return {"slack_N": p.slack_m * reel.stiffness_N_m}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The root T of T^2 + (T_s + k s - l) T = l T_s, above zero where l is."""
        pulled = ca.fmax(signal, 0.0)
        half = 0.5 * (pulled - p.bedding_N - p.slack_N)
        root = ca.sqrt(half * half + pulled * p.bedding_N)
        # Without slack the root is |l + T_s|/2 and this is l to rounding.
        return state, half + root + (signal - pulled)

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The linear law's tension."""
        pulled = ca.fmax(signal, 0.0)
        return state, signal + p.slack_N * pulled / (pulled + p.bedding_N)
