"""The cable as a string."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter
from plants.effects.oscillator import stepping


@dataclass(frozen=True)
class StringMode(Effect):
    """The cable's first transverse mode: its sag needs time to follow the tension.

        v'' + 2 zeta w v' = w^2 (1 - v T/T_0),    w = (pi/L) sqrt(T_0/mu)
        T = l + c k q/T_0^2 (v^2 - 1),    q = 4 (mu g)^2 L^3/pi^4

    v is the sag relative to that at the preload T_0, where the string has the frequency (31).
    With one sine for its shape the sag 4 mu g L^2/(pi^3 T_0) of a level cable takes up the length
    q/T_0^2, within 2 % of the parabola's (Irvine 1981): slowly, the cable gives by 2 q/T^3 more
    than the linear law says; faster than the string, sag cannot follow. So what the string shows
    grows with the length's and falls with the tension's third power.

    Attributes:
        coupling: What gravity's part across the cable squared is of that of a level cable, c:
            cos^2 of the inclination.
        density_kg_m: Mass mu per length of the cable that swings, kg/m.
        damping: Damping ratio zeta.
    """

    name: ClassVar[str] = "string_mode"
    title: ClassVar[str] = "string mode of the cable"
    appearance: ClassVar[str] = (
        "a narrow resonance that rises with the root of the tension and falls with the length"
    )
    port: ClassVar[Port] = Port.CABLE
    states: ClassVar[int] = 2

    coupling: float = parameter(1.0, low=0.0, high=2.0, unit="", neutral=0.0)
    density_kg_m: float = parameter(0.05, low=0.002, high=0.5, unit="kg/m")
    damping: float = parameter(0.01, low=1e-3, high=0.5, unit="")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The string over a substep, and how it acts on the tension."""
        L, T_0 = reel.cable_length_m, reel.preload_N
        w = math.pi / L * ca.sqrt(T_0 / p.density_kg_m)
        keep, pull = stepping(w, p.damping, reel.substep_s)
        q = 4.0 * (p.density_kg_m * reel.gravity_m_s2) ** 2 * L**3 / math.pi**4
        return {
            "keep": keep,
            "pull": pull,
            "given_N": p.coupling * reel.stiffness_N_m * q / T_0**2,
            "preload_N": T_0,
            "per_preload": 1.0 / T_0,
        }

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the span is in the numbers prepared
    ) -> tuple[Signal, Signal]:
        """The tension with what the string adds."""
        v, last = state[0], state[1]
        tension = signal + p.given_N * (v * v - 1.0)
        step = p.keep * last + p.pull * (1.0 - v * (ca.fmax(tension, 0.0) * p.per_preload))
        return ca.vertcat(v + step, step), tension

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the sag
        signal: Signal,
        site: Site,  # noqa: ARG004  the same at any angle
    ) -> tuple[Signal, Signal]:
        """The sag at this tension, and the linear law's tension."""
        v = p.preload_N / ca.fmax(signal, 0.05 * p.preload_N)
        return ca.vertcat(v, 0.0), signal - p.given_N * (v * v - 1.0)
