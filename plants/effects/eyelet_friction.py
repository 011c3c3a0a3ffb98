"""Friction where the cable passes the eyelet."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, Share, parameter
from plants.effects.plant_scale import PlantScale, share
from plants.effects.remedy import Remedy, in_loop, known_motion, workshop

TINY = 1e-9
"""Keeps lengths and tensions that are divided by above zero."""
FULL = 1.5
"""Velocity, in those of the creep, from which on friction is full."""


def saturated(x: Signal) -> Signal:
    """Share of full friction at a velocity: a cubic, at zero as steep as tanh, that ends level.

    It differs from tanh by up to 0.1: the creep law of a cable is not known better.
    """
    x = ca.fmin(ca.fmax(x, -FULL), FULL)
    return x * (1.0 - (x * x) * (4.0 / 27.0))


def slid(z: Signal, goal: Signal, travel: Signal, knee: Signal) -> Signal:
    """Built-up share of friction after some travel.

    With what is left, L = s (g - z)/2, s = sign(g - z): dL/dx = -(1 + a) L/(L + a). At a = 0 it
    ends in a kink, far above one it is Dahl's exponential (1968). Taken is an implicit step, which
    is exact in a kink: powers and exponentials in each substep would double the cost of a trial.

    Args:
        z: Share before, -1 to 1.
        goal: Final share g.
        travel: Travel in lengths d, after which it would reach g at the initial rate.
        knee: Width a.
    """
    gap = goal - z
    left = 0.5 * ca.fabs(gap)
    before = left - knee - (1.0 + knee) * travel
    after = 0.5 * (before + ca.sqrt(before * before + 4.0 * knee * left))
    return goal - 2.0 * ca.sign(gap) * after


@dataclass(frozen=True)
class EyeletFriction(Effect):
    """Dry friction at the eyelet: the tension inside exceeds that outside when winding in.

        T = r T_o,    r = 1 + z (1/B - B)/2 + z^2 (1/B + B - 2)/2,    T_o = l/(1 - c + c r)
        dz/dt = 2 s (abs(v) + v_c)/d (1 + a) L/(L + a),    L = s (g - z)/2 >= 0,    g = sat(v/v_c)
        d = 2 T ln(1/B) c/k

    r is close to B^(-z), the capstan's ratio with a share z of its friction: with the attenuation
    ratio B of (23) the cable slides in with T_o = B T, z = 1, and out with T = B T_o, z = -1. The
    share c of the reel's flexibility 1/k lies between drum and eyelet and is stretched by T,
    the rest by T_o; l is the tension of the linear law. After a reversal of the cable's velocity v
    the cable first sticks in the eyelet and only the part inside gives: so d is the travel that
    changes T by what friction does, from sliding out to sliding in. A short eyelet lets go of the
    cable as a whole, with a sharp knee, a near 0; in a long one, or where fibres bend first, it
    gives before: see `slid`. Below the velocity v_c the cable creeps; where that is far below all
    velocities there are it sticks. z starts at zero. The record then has the tension outside as
    `reference_N`.

    Attributes:
        attenuation: Attenuation ratio B.
        inner_share: Share c of the flexibility that lies between drum and eyelet. One so small
            that the drum would swing on it within a substep sticks as the least that would not.
        knee: Width a of the knee between sticking and sliding, as a share of what friction does.
        creep_rad_s: Velocity v_c of the drum below which the cable creeps, rad/s.
    """

    name = "eyelet_friction"
    title = "friction at the eyelet"
    appearance = (
        "tension read against angle is a loop whose height grows with the tension, "
        "while current and tension read agree"
    )
    excitation = "slow reversals at several tensions"
    port = Port.EYELET
    also = (Port.CABLE,)
    states = 1

    attenuation: float = parameter(0.95, low=0.35, high=1.0, neutral=1.0)
    inner_share: float = parameter(0.2, low=1e-4, high=0.9, start=(0.03, 0.3))
    knee: float = parameter(0.1, low=0.01, high=30.0, start=(0.1,))
    creep_rad_s: float = parameter(
        1e-4,
        low=ABOVE_ZERO,
        unit="rad/s",
        between=(Share(1e-6, "velocity_max_rad_s"), Share(2.0, "velocity_max_rad_s")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        B, lost = p.attenuation, (1.0 - p.attenuation) * plant.tension_N
        less = (
            ""
            if math.isnan(lost)
            else f" ({plant.reading(lost)} less at {plant.reading(plant.tension_N)})"
        )
        inside, slowly = share(p.inner_share), plant.speed(p.creep_rad_s)
        return (
            f"has eyelet friction: outside tension is {B:.3g} of inside when winding in{less}, "
            "the other way round when paying out. After a reversal the cable sticks: "
            f"{inside} of what gives is inside the eyelet. Below {slowly} it creeps"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        # From one end to the other z turns over the length that gives 2 c ln(1/B) of the tension:
        # by 63 % over half of it.
        stiffness = plant.stiffness_N_m * plant.radius_m
        turned = -math.log(p.attenuation) * p.inner_share * plant.tension_N / stiffness
        table = {"attenuation": p.attenuation, "memory_rad": turned} | known_motion(plant)
        title = "take the eyelet's friction off the gauge along the known motion"
        harm = "a loop whose noise moves the drum wears the friction off: it then does harm"
        return (
            in_loop(plant, title, "attenuation", ("eyelet", table), harm),
            workshop("put a pulley in the place of the eyelet"),
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The factors of z and z^2, 1/v_c, and what travel changes z by, in N s/rad."""
        within, without = 1.0 / p.attenuation, p.attenuation
        stiffness_Nm_rad = reel.stiffness_N_m * reel.drum_radius_m**2
        inside = ca.fmax(
            p.inner_share, stiffness_Nm_rad * reel.substep_s / reel.torque_per_velocity
        )
        return {
            "odd": 0.5 * (within - without),
            "even": 0.5 * (within + without) - 1.0,
            "per_creep": 1.0 / p.creep_rad_s,
            "travel_Ns_rad": reel.drum_radius_m
            * reel.substep_s
            * reel.stiffness_N_m
            / (2.0 * ca.log(within) * inside + TINY),
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """At the cable the tension outside, then at the eyelet that inside."""
        ratio = state * (p.odd + state * p.even)
        if site.port is Port.EYELET:
            return state, signal * (1.0 + ratio)
        velocity = site.start_velocity_rad_s
        speed = ca.fabs(velocity) + p.creep_rad_s
        # The share of the flexibility inside, and all of it, times the tension inside.
        gone = p.travel_Ns_rad * speed * (1.0 + p.inner_share * ratio)
        gone = gone / (ca.fmax(signal, TINY) * (1.0 + ratio))
        z = slid(state, saturated(velocity * p.per_creep), gone, p.knee)
        return z, signal / (1.0 + p.inner_share * z * (p.odd + z * p.even))

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The tension outside of that inside, then the linear law's, with friction as it is."""
        ratio = state * (p.odd + state * p.even)
        if site.port is Port.EYELET:
            return state, signal / (1.0 + ratio)
        return state, signal * (1.0 + p.inner_share * ratio)
