"""Calibration of torque and gauge as an effect, so that a fitted model can carry it."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from plants.effects import Effect, Port, Signal, Site, parameter
from plants.effects.cable_slack import TINY_N, straightened, stretched
from plants.effects.effect import Response, Values


@dataclass(frozen=True)
class Calibration(Effect):
    """Gain and offset of the torque and offset of the gauge: trivial, and never named as missing.

        tau = (g Kt) i + tau_0,    y = T + T_0

    The gain acts between current and torque: a measured current does not show it, and the
    controller keeps the torque constant it was given.

    Attributes:
        torque_gain: Torque g relative to that of the torque constant.
        torque_offset_Nm: Constant torque tau_0, N m.
        gauge_offset_N: Reading of the gauge without tension, T_0, N.
    """

    name = "calibration"
    title = "calibration of torque and gauge"
    appearance = (
        "torque and tension read stand in another ratio, or differ by a constant, at any motion"
    )
    port = Port.DRUM
    also: ClassVar[tuple[Port, ...]] = (Port.GAUGE,)

    torque_gain: float = parameter(1.0, low=1e-3, high=1e3, neutral=1.0)
    torque_offset_Nm: float = parameter(0.0, low=-math.inf, unit="N m", neutral=0.0)
    gauge_offset_N: float = parameter(0.0, low=-math.inf, unit="N", neutral=0.0)

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        """The torque constant that acts; the controller keeps its own."""
        return {"torque_constant_Nm_A": reel.torque_constant_Nm_A * p.torque_gain}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The torque at the drum, then the reading."""
        return state, p.torque_offset_Nm if site.port is Port.DRUM else signal + p.gauge_offset_N

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The same torque; the tension that reads so."""
        return state, p.torque_offset_Nm if site.port is Port.DRUM else signal - p.gauge_offset_N


@dataclass(frozen=True)
class SaggingCalibration(Calibration):
    """Calibration of a reel at tensions so low that the sag of its own cable bends the linear law.

        a T - Q/T^2 = l + a T_0 - Q/T_0^2 - T_0,    Q = k (w + dw)^2 L^3/24

    Sag takes up q/T^2 of length (Irvine 1981), of which the linear law l = k R theta has the slope
    of the own weight w at the preload T_0, so that a = 1 - k w^2 L^3/(12 T_0^3). The root is found
    anew in each substep by one step of Newton's method. What `plants.effects.CableWeight` adds,
    dw, is reckoned with here, and so is what `plants.effects.CableSlack` takes up: sag beside
    slack lengthens the cable, so that a T is of the stretch that the straightened strands have.
    """

    also = (Port.GAUGE, Port.CABLE)
    states = 2
    by_tension = True

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        """The torque constant, and a flag for effects that add to the weight."""
        return {**Calibration.amend(p, reel), "sags_in_full": 1.0}

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The constants a, Q in N^3, what is added to l, and the slack in N."""
        del p
        unit = reel.stiffness_N_m * reel.gravity_m_s2**2 * reel.cable_length_m**3 / 24.0
        own_kg_m, added_kg_m = reel.cable_density_kg_m, vars(reel).get("added_density_kg_m", 0.0)
        # The third root stays differentiable where there is no weight.
        Q = unit * (own_kg_m + added_kg_m) ** 2 + 1e-30
        a, preload = 1.0 - 2.0 * unit * own_kg_m**2 / reel.preload_N**3, reel.preload_N
        slack = {}
        if "slack_m" in vars(reel):
            # What is taut has the stiffness without sag, k/a.
            slack["slack_N"] = reel.slack_m * reel.stiffness_N_m / a + TINY_N
        return slack | {
            "a": a,
            "Q": Q,
            "root": (Q / a) ** (1.0 / 3.0),
            "shift": a * preload - Q / preload**2 - preload,
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The tension at the cable; elsewhere as without sag."""
        if site.port is not Port.CABLE:
            return Calibration.respond(p, state, signal, site)
        s, slack = signal + p.shift, vars(p).get("slack_N", 0.0)
        start = ca.fmax(2.0 * state[0] - state[1], 0.125 * state[0])
        tension, slope = _straightened(p, start)
        beyond = (p.a * (start - slack) - s) * tension**2 - p.Q
        stretch = start - beyond * tension / (p.a * tension**3 + 2.0 * p.Q * slope)
        # The root lies above s/a, and stays above zero in however fast a fall.
        stretch = ca.fmax(ca.fmax(stretch, s / p.a + slack), ca.fmin(0.125 * start, p.root))
        return ca.vertcat(stretch, state[0]), _straightened(p, stretch)[0]

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The linear law's tension at the cable; elsewhere as without sag."""
        if site.port is not Port.CABLE:
            _, changed = Calibration.rest(p, state, signal, site)
            start = _stretched(p, site.tension_N)
            return ca.vertcat(start, start), changed
        tension, slack = ca.fmax(signal, 0.1 * p.root), vars(p).get("slack_N", 0.0)
        stretch = _stretched(p, tension)
        linear = p.a * (stretch - slack) - p.Q / tension**2 - p.shift
        return ca.vertcat(stretch, stretch), linear


def _straightened(p: Values, stretch: Signal) -> tuple[Signal, Signal]:
    """Tension and slope at a stretch, where there is slack; without, they are the same."""
    return straightened(stretch, p.slack_N) if "slack_N" in vars(p) else (stretch, 1.0)


def _stretched(p: Values, tension: Signal) -> Signal:
    return stretched(tension, p.slack_N) if "slack_N" in vars(p) else tension
