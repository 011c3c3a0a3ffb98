"""Laws without a name, with which every named effect is compared.

Each is a difference between model and machine that is no declared effect but may be mistaken for
one: a loop of constant height for friction at the eyelet, whose loop grows with the tension; a
gain that changes with time for an offset that does; any function of the velocity for dry friction.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca

from plants.effects import Effect, Port, Signal, Site, parameter
from plants.effects.bristles import bent
from plants.effects.effect import Response, Values
from plants.effects.parameter import ABOVE_ZERO, Share


def _torque() -> float:
    value: float = parameter(
        0.01,
        low=-math.inf,
        unit="N m",
        neutral=0.0,
        between=(Share(-2.0, "torque_max_Nm"), Share(2.0, "torque_max_Nm")),
    )
    return value


@dataclass(frozen=True)
class VelocityCurve(Effect):
    """A torque that is some function of the velocity w: piecewise linear in `w/(|w| + w_s)`.

    Attributes:
        down_3_Nm: The torque against the motion at the first knot, N m; the others follow.
        scale_rad_s: The velocity w_s at which half the range is gone through, rad/s.
    """

    name = "velocity_curve"
    title = "a smooth function of the velocity"
    appearance = "what is missing of the torque is the same at the same velocity"
    port = Port.DRUM

    down_3_Nm: float = _torque()
    down_2_Nm: float = _torque()
    down_1_Nm: float = _torque()
    up_1_Nm: float = _torque()
    up_2_Nm: float = _torque()
    up_3_Nm: float = _torque()
    scale_rad_s: float = parameter(
        1.0,
        low=ABOVE_ZERO,
        unit="rad/s",
        between=(Share(1e-4, "velocity_max_rad_s"), Share(2.0, "velocity_max_rad_s")),
    )

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        """The torque of a linearly implicit step: held explicitly, a steep curve would chatter."""
        w = site.start_velocity_rad_s
        far = ca.fabs(w) + p.scale_rad_s
        values = (p.down_3_Nm, p.down_2_Nm, p.down_1_Nm, p.up_1_Nm, p.up_2_Nm, p.up_3_Nm)
        torque, slope = values[0], 0.0
        knots = (-1.0, -0.5, -0.15, 0.15, 0.5, 1.0)
        for n, (a, b) in enumerate(pairwise(knots)):
            part, rise = (w / far - a) / (b - a), values[n + 1] - values[n]
            torque += rise * ca.fmin(ca.fmax(part, 0.0), 1.0)
            inside = ca.logic_and(part >= 0.0, part < 1.0)
            slope += inside * rise / (b - a) * p.scale_rad_s / far**2
        return state, -torque / (1.0 + ca.fmax(slope, 0.0) / site.torque_per_velocity)


@dataclass(frozen=True)
class CableLoop(Effect):
    """A strand that slips beside the cable: `T = l + F z`, `dz/dl = (sign(dl) - z)/d`.

    l is the tension of the linear law, z is 0 at the start.

    Attributes:
        height_N: Force F once it slips, N.
        reach_N: Change d of the linear law's tension over which it builds up, N.
    """

    name = "cable_loop"
    title = "a loop of the cable that does not grow with the tension"
    appearance = "tension against angle is a loop of the same height at any tension"
    port = Port.CABLE
    states = 2

    height_N: float = parameter(
        0.5,
        low=0.0,
        unit="N",
        neutral=0.0,
        start=Share(0.0125, "reading_max_N"),
        between=(Share(0.0), Share(2.5, "reading_max_N")),
    )
    reach_N: float = parameter(
        4.0,
        low=ABOVE_ZERO,
        unit="N",
        start=Share(0.1, "reading_max_N"),
        between=(Share(2.5e-3, "reading_max_N"), Share(2.5, "reading_max_N")),
    )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The tension of both."""
        z = state[0] + bent(state[0], (signal - state[1]) / p.reach_N)
        return ca.vertcat(z, signal), signal + p.height_N * z

    @staticmethod
    def rest(_p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """The strand has given way to what is steady."""
        return ca.vertcat(0.0, signal), signal


@dataclass(frozen=True)
class GaugeLoop(CableLoop):
    """The same loop of what the gauge reads: `y = T + F z`, `dz/dT = (sign(dT) - z)/d`."""

    name = "gauge_loop"
    title = "a loop of the gauge that does not grow with the tension"
    port = Port.GAUGE


@dataclass(frozen=True)
class GaugeWarming(Effect):
    """A gauge whose gain changes from the start on: `y = (1 + s) T`, `ds/dt = (g - s)/tau`.

    Attributes:
        gain: Share g by which it reads more in the end.
        time_s: Time constant tau, s.
    """

    name = "gauge_warming"
    title = "a gain of the gauge that changes with time"
    appearance = "tension read and current move apart the more, the more it pulls"
    port = Port.GAUGE
    states = 1

    gain: float = parameter(0.03, low=-0.5, high=0.5, neutral=0.0)
    time_s: float = parameter(
        2.0,
        low=ABOVE_ZERO,
        unit="s",
        start=Share(0.2, "record_s"),
        between=(Share(0.02, "record_s"), Share(5.0, "record_s")),
    )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The tension read; what is remembered is the gain's change."""
        after = p.gain + (state - p.gain) * ca.exp(-site.span_s / p.time_s)
        return after, signal * (1.0 + state)


@dataclass(frozen=True)
class CableBend(Effect):
    """A cable whose tension is some curve of its stretch: `T = l + b l |l| + c l^3`.

    Attributes:
        bend_per_N: The coefficient b, 1/N.
        bend_per_N2: The coefficient c, 1/N2.
    """

    name = "cable_bend"
    title = "a plain curve of tension against angle, bent at no certain tension"
    appearance = "tension against angle is bent, most where it pulls the most"
    port = Port.CABLE

    bend_per_N: float = parameter(
        3e-3,
        low=-math.inf,
        unit="1/N",
        neutral=0.0,
        start=Share(0.12, "per_reading_per_N"),
        between=(Share(-0.2, "per_reading_per_N"), Share(4.0, "per_reading_per_N")),
    )
    bend_per_N2: float = parameter(
        1e-5,
        low=-math.inf,
        unit="1/N2",
        neutral=0.0,
        start=Share(0.016, "per_square_per_N2"),
        between=(Share(-0.08, "per_square_per_N2"), Share(16.0, "per_square_per_N2")),
    )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The tension."""
        return state, signal * _stiffer(p, ca.fabs(signal))

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The linear law's tension, by a secant to the origin, again and again."""
        linear = signal
        # Each halves the error: what is left is far below the noise floor.
        for _ in range(20):
            linear = 0.5 * (linear + signal / _stiffer(p, ca.fabs(linear)))
        return state, linear


def _stiffer(p: Values, size: Signal) -> Signal:
    """Tension per that of the linear law; a curve that bends down is straight before it falls."""
    return ca.fmax(1.0 + size * (p.bend_per_N + size * p.bend_per_N2), 0.5)


NAMELESS = (VelocityCurve, CableBend, CableLoop, GaugeLoop, GaugeWarming)
