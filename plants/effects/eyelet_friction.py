"""Friction where the cable passes the eyelet."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects.bristles import bent
from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class EyeletFriction(Effect):
    """Dry friction at the eyelet: the tension inside exceeds that outside when winding in.

        T = T_o (1 + z (1/B - B)/2 + z^2 (1/B + B - 2)/2),    dz/dx = (sign(dx) - z)/d

    With the attenuation ratio B of (23) the cable slides in with T_o = B T, at z = 1, and out with
    T = B T_o, at z = -1. Between, z follows the cable's travel x over the length d as Dahl's
    bristles do; it starts at zero. The record then has the tension outside as `reference_N`.

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

    attenuation: float = parameter(0.95, low=0.35, high=1.0, unit="", neutral=1.0)
    slip_m: float = parameter(5e-4, low=5e-5, high=0.05, unit="m")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The factors of z and z^2, and slip lengths travelled per velocity, s/rad."""
        within, without = 1.0 / p.attenuation, p.attenuation
        return {
            "odd": 0.5 * (within - without),
            "even": 0.5 * (within + without) - 1.0,
            "travel_s_rad": reel.drum_radius_m * reel.substep_s / p.slip_m,
        }

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The tension inside."""
        z = state + bent(state, p.travel_s_rad * site.start_velocity_rad_s)
        return z, signal * (1.0 + z * (p.odd + z * p.even))
