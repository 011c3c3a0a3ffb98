"""Slack that is taken up before the cable holds."""

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, si
from plants.effects.remedy import limit

TINY_N = 1e-30
"""Slack that no tension feels, so that none at zero tension is not 0/0."""


NEWTON_ROUNDS = 6
"""From above on a convex law; they end within rounding of the root."""


def straightened(stretch: Signal, slack: Signal) -> Response:
    """Tension and its slope, of a cable whose linear law says a tension of stretch less slack.

    Args:
        stretch: Tension of the linear law from where the first strand holds, N.
        slack: The slack as a tension of the linear law, N; no less than `TINY_N`.
    """
    x = ca.fmin(ca.fmax(stretch / slack, 0.0), 2.0)
    late = ca.fmax(x - 1.0, 0.0)
    bend = (1.0 / 6.0) * (x * x) * x - (1.0 / 3.0) * (late * late) * late
    return slack * bend + ca.fmax(stretch - 2.0 * slack, 0.0), 0.5 * (x * x) - late * late


def stretched(tension: Signal, slack: Signal) -> Signal:
    """The stretch, as in `straightened`, at a tension: a third root, Newton's method, or the same.

    Args:
        tension: N; a cable without any has no stretch.
        slack: As there.
    """
    t = ca.fmin(ca.fmax(tension, 0.0) / slack, 1.0)
    bent = t + 1.0
    for _ in range(NEWTON_ROUNDS):
        left = 2.0 - bent
        bent -= (bent - 1.0 + left**3 / 6.0 - t) / (1.0 - 0.5 * left**2)
    early = (6.0 * t + TINY_N) ** (1.0 / 3.0)
    bend = slack * ca.if_else(6.0 * t > 1.0, bent, early)
    return ca.if_else(tension > slack, tension + slack, bend)


@dataclass(frozen=True)
class CableSlack(Effect):
    """Extra length taken up before the cable holds, as of loose windings that bed in.

        T = k s (x^3 - 2 (x - 1)^3 + (x - 2)^3)/6,    x = 1 + R theta/s

    with powers of positive parts only: `T = k R theta` from R theta = s on, where all of the
    cable holds. Strands come taut one after the other (sequential straightening and loading,
    Kastelic, Palley & Baer 1980), over lengths spread as a triangle between -s and s, most of
    them about where the reel's own cable, which holds at once, is just taut. So only the
    low-tension region changes, and the parameters of the taut cable do not. Where the reel models
    its own weight at any tension, this law is part of that one, and nothing is done here.

    Attributes:
        slack_m: The slack s that the cable has where the straight law says it is just taut, m.
    """

    name = "cable_slack"
    title = "slack of the cable"
    appearance = (
        "near zero tension the angle moves far for little tension; "
        "well above, the cable is as stiff as ever"
    )
    excitation = "slow ramps to zero tension and back"
    port = Port.CABLE
    by_tension = True
    plain_remedies = (
        limit("keep the tension above zero (limits.tension_min_N): it costs nothing while taut"),
    )

    # A cable that never comes taut is one that stiffens.
    slack_m: float = parameter(
        5e-4,
        low=0.0,
        unit="m",
        neutral=0.0,
        start=Share(0.1, "stretch_max_m"),
        between=(Share(0.0), Share(10.0, "stretch_max_m")),
        most=(Share(1.0, "stretch_max_m"),),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        until = 2.0 * plant.stiffness_N_m * p.slack_m
        firm = "" if math.isnan(until) else f"; from {si(until, 'N')} on it is as stiff as ever"
        return (
            f"has {plant.cable(p.slack_m)} of slack that is taken up before the cable holds{firm}"
        )

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        """The slack, for a reel whose own weight sags at any tension."""
        return {"slack_m": vars(reel).get("slack_m", 0.0) + p.slack_m}

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The slack as a tension of the linear law, N."""
        return {
            "slack_N": p.slack_m * reel.stiffness_N_m + TINY_N,
            "done": vars(reel).get("sags_in_full", 0.0),
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The tension; a slack cable stays slack."""
        tension, _ = straightened(signal + p.slack_N, p.slack_N)
        return state, tension + p.done * (signal - tension)

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        linear = stretched(signal, p.slack_N) - p.slack_N
        return state, linear + p.done * (signal - linear)
