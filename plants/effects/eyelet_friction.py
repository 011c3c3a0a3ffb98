"""Friction where the cable passes the eyelet."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class EyeletFriction(Effect):
    """Dry friction at the eyelet: the tension inside exceeds that outside when winding in.

        T = T_o B^(-z),    dz/dx = (sign(dx) - z)/d

    With B the attenuation ratio of (23), which `estune.reel` works out of the cable's angles and
    the friction coefficient: the cable slides in with T_o = B T and out with T = B T_o. Between,
    z follows the cable's travel x over the length d as Dahl's bristles do; it starts at zero. The
    record then has the tension outside as `reference_N`.

    Attributes:
        attenuation: Attenuation ratio B.
        slip_m: Travel d of the cable over which friction builds up, m.
    """

    name: ClassVar[str] = "eyelet_friction"
    title: ClassVar[str] = "friction at the eyelet"
    appearance: ClassVar[str] = (
        "tension read against angle is a loop whose height grows with the tension, "
        "while current and tension read agree"
    )
    port: ClassVar[Port] = Port.EYELET
    states: ClassVar[int] = 1

    attenuation: float = parameter(0.95, low=0.3, high=1.0, unit="", neutral=1.0)
    slip_m: float = parameter(5e-4, low=5e-5, high=0.05, unit="m")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Logarithm of the ratio, and share of the slip length travelled per velocity, s/rad."""
        travel = reel.drum_radius_m * reel.substep_s / p.slip_m
        return {"logarithm": -ca.log(p.attenuation), "travel_s_rad": travel}

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The tension inside."""
        velocity = site.start_velocity_rad_s
        direction = ca.sign(velocity)
        kept = ca.exp(-p.travel_s_rad * ca.fabs(velocity))
        z = direction + (state - direction) * kept
        return z, signal * ca.exp(p.logarithm * z)
