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
        T = l + c/(1 - c) (l - T_0 (2 - v))

    v is the sag relative to that at the preload T_0, c the sag's share in the reel's flexibility
    1/k: slowly, the cable gives as the linear law says; faster than the string, whose frequency is
    that of (31), sag cannot follow and the cable is 1/(1 - c) times as stiff.
    One sine for the string's shape gives c = k (pi y_0)^2/(2 L T_0) with the sag
    y_0 = 4 mu g L^2/(pi^3 T_0).

    Attributes:
        coupling: The share c.
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

    coupling: float = parameter(0.05, low=0.0, high=0.5, unit="", neutral=0.0)
    density_kg_m: float = parameter(0.007, low=0.002, high=0.5, unit="kg/m")
    damping: float = parameter(0.01, low=1e-3, high=0.5, unit="")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The string over a substep, and how it acts on the tension."""
        w = math.pi / reel.cable_length_m * ca.sqrt(reel.preload_N / p.density_kg_m)
        keep, pull = stepping(w, p.damping, reel.substep_s)
        gain = p.coupling / (1.0 - p.coupling)
        return {
            "keep": keep,
            "pull": pull,
            "stiffer": 1.0 + gain,
            "preload_N": reel.preload_N,
            "share_N": gain * reel.preload_N,
            "per_preload": 1.0 / reel.preload_N,
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
        tension = p.stiffer * signal - p.share_N * (2.0 - v)
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
        tension = ca.fmax(signal, 0.05 * p.preload_N)
        v = p.preload_N / tension
        linear = (tension + p.share_N * (2.0 - v)) / p.stiffer
        return ca.vertcat(v, 0.0), linear
