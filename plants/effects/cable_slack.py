"""Slack that is taken up before the cable holds."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

TINY_N = 1e-30
"""Slack that no tension feels, so that none at zero tension is not 0/0."""


NEWTON_ROUNDS = 6
"""From above on a convex law; they end within rounding of the root."""


@dataclass(frozen=True)
class CableSlack(Effect):
    """Extra length taken up before the cable holds, as of loose windings that bed in.

        T = k s (x^3 - 2 (x - 1)^3 + (x - 2)^3)/6,    x = 1 + R theta/s

    with powers of positive parts only: `T = k R theta` from R theta = s on, where all of the
    cable holds. Strands come taut one after the other (sequential straightening and loading,
    Kastelic, Palley & Baer 1980), over lengths spread as a triangle between -s and s, most of
    them about where the reel's own cable, which holds at once, is just taut. So nothing but the
    toe is another: what is known of the taut cable need not change with the slack.

    Attributes:
        slack_m: The slack s that the cable has where the straight law says it is just taut, m.
    """

    name: ClassVar[str] = "cable_slack"
    title: ClassVar[str] = "slack of the cable"
    appearance: ClassVar[str] = (
        "near zero tension the angle moves far for little tension; "
        "well above, the cable is as stiff as ever"
    )
    port: ClassVar[Port] = Port.CABLE

    slack_m: float = parameter(5e-4, low=0.0, high=0.05, unit="m", neutral=0.0)

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The slack as a tension of the linear law, N."""
        slack = p.slack_m * reel.stiffness_N_m + TINY_N
        return {"slack_N": slack, "per_N": 1.0 / slack}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension; a slack cable stays slack."""
        x = ca.fmin(ca.fmax(1.0 + signal * p.per_N, 0.0), 2.0)
        late = ca.fmax(x - 1.0, 0.0)
        toe = (1.0 / 6.0) * (x * x) * x - (1.0 / 3.0) * (late * late) * late
        return state, p.slack_N * toe + ca.fmax(signal - p.slack_N, 0.0)

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The linear law's tension: a third root, Newton's method, or the same."""
        t = ca.fmin(ca.fmax(signal, 0.0) * p.per_N, 1.0)
        bent = t + 1.0
        for _ in range(NEWTON_ROUNDS):
            left = 2.0 - bent
            bent -= (bent - 1.0 + left**3 / 6.0 - t) / (1.0 - 0.5 * left**2)
        early = (6.0 * t + TINY_N) ** (1.0 / 3.0)
        toe = p.slack_N * (ca.if_else(6.0 * t > 1.0, bent, early) - 1.0)
        return state, ca.if_else(signal > p.slack_N, signal, toe)
