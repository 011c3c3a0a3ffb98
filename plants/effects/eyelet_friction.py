"""Friction where the cable passes the eyelet."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter

TINY = 1e-9
"""Keeps lengths and tensions that are divided by above zero."""
KNEE = 0.25
"""Dahl's exponent i of the knee between sticking and sliding; at zero it would be a kink."""


def slid(z: Signal, travel: Signal) -> Signal:
    """How far friction is built up after some travel: dz/dx = 2 s ((1 - s z)/2)^i, s = sign(dx).

    Dahl's law (1968) with an exponent below one, which he found where little gives before all
    slides. It ends at s after a finite travel: ((1 - s z)/2)^(1 - i) falls evenly.

    Args:
        z: What is built up before, -1 to 1.
        travel: Signed travel in lengths d, after which it would be there at the first rate.
    """
    s = ca.sign(travel)
    left = ca.fmax(0.5 * (1.0 - s * z), TINY)
    after = ca.fmax(left ** (1.0 - KNEE) - (1.0 - KNEE) * ca.fabs(travel), 0.0)
    return z * (1.0 - s * s) + s * (1.0 - 2.0 * after ** (1.0 / (1.0 - KNEE)))


@dataclass(frozen=True)
class EyeletFriction(Effect):
    """Dry friction at the eyelet: the tension inside exceeds that outside when winding in.

        T = r T_o,    r = 1 + z (1/B - B)/2 + z^2 (1/B + B - 2)/2
        T_o = l/(1 - c + c r),    dz/dx = 2 s/d ((1 - s z)/2)^i,    d = (1/B - B) l c/((1 - c) k)

    With the attenuation ratio B of (23) the cable slides in with T_o = B T, at z = 1, and out with
    T = B T_o, at z = -1. The share c of the reel's flexibility 1/k lies between drum and eyelet
    and is stretched by T, the rest by T_o; l is the tension of the linear law. After a reversal of
    the cable's travel x the cable first sticks in the eyelet and only the part inside gives: so d
    is the travel that changes T by what friction does. A short eyelet lets go of the cable as a
    whole, so that the knee where it begins to slide is sharp: see `slid`. z starts at zero. The
    record then has the tension outside as `reference_N`.

    Attributes:
        attenuation: Attenuation ratio B.
        inner_share: Share c of the flexibility that lies between drum and eyelet.
    """

    name: ClassVar[str] = "eyelet_friction"
    title: ClassVar[str] = "friction at the eyelet"
    appearance: ClassVar[str] = (
        "tension read against angle is a loop whose height grows with the tension, "
        "while current and tension read agree"
    )
    port: ClassVar[Port] = Port.EYELET
    also: ClassVar[tuple[Port, ...]] = (Port.CABLE,)
    states: ClassVar[int] = 1

    attenuation: float = parameter(0.95, low=0.35, high=1.0, unit="", neutral=1.0)
    inner_share: float = parameter(0.2, low=0.01, high=0.9, unit="")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The factors of z and z^2, and what travel changes z by, in N s/rad."""
        within, without = 1.0 / p.attenuation, p.attenuation
        inside = p.inner_share / (1.0 - p.inner_share)
        return {
            "odd": 0.5 * (within - without),
            "even": 0.5 * (within + without) - 1.0,
            "travel_Ns_rad": reel.drum_radius_m
            * reel.substep_s
            * reel.stiffness_N_m
            / ((within - without) * inside + TINY),
        }

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """At the cable the tension outside, then at the eyelet that inside."""
        if site.port is Port.EYELET:
            return state, signal * (1.0 + state * (p.odd + state * p.even))
        gone = p.travel_Ns_rad * site.start_velocity_rad_s / ca.fmax(signal, TINY)
        z = slid(state, gone)
        return z, signal / (1.0 + p.inner_share * z * (p.odd + z * p.even))

    @staticmethod
    def rest(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The tension outside of that inside, then the linear law's, with friction as it is."""
        ratio = state * (p.odd + state * p.even)
        if site.port is Port.EYELET:
            return state, signal / (1.0 + ratio)
        return state, signal * (1.0 + p.inner_share * ratio)
