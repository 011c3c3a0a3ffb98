"""The cable as a string."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from plants.effects.cable_weight import CableWeight
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.oscillator import stepping
from plants.effects.parameter import ABOVE_ZERO, RecordScale, Share, parameter
from plants.effects.plant_scale import PlantScale, share, si
from plants.effects.remedy import limit


def _ringing_densities(records: RecordScale) -> list[float]:
    """Densities whose string would ring where the residual does: f = 1/(2 L) sqrt(T/mu) (31)."""
    if math.isnan(records.cable_length_m):
        return []
    positive = (f for f in records.resonances_Hz if f > 0.0)
    return [records.preload_N / (2.0 * records.cable_length_m * f) ** 2 for f in positive]


@dataclass(frozen=True)
class StringMode(Effect):
    """The cable's first transverse mode: its sag needs time to follow the tension.

        v'' + 2 zeta w v' = w^2 (1 - v T/T_0),    w = (pi/L) sqrt(T_0/mu)
        T = l + c k q/T_0^2 (v^2 - 1),    q = 4 (mu g)^2 L^3/pi^4

    v is the sag relative to that at the preload T_0, where the string has the frequency (31).
    With one sine for its shape the sag 4 mu g L^2/(pi^3 T_0) of a level cable takes up the length
    q/T_0^2, within 2 % of the parabola's (Irvine 1981): slowly, the cable gives by 2 q/T^3 more
    than the linear law says; faster than the string, sag cannot follow. So what the string shows
    grows with the length's and falls with the tension's third power. Five densities of hidden
    strings were found off by 1 to 3 %.

    Attributes:
        coupling: What gravity's part across the cable squared is of that of a level cable, c:
            cos^2 of the inclination.
        density_kg_m: Mass mu per length of the cable that swings, kg/m.
        damping: Damping ratio zeta.
    """

    name = "string_mode"
    title = "string mode of the cable"
    appearance = (
        "a narrow resonance that rises with the root of the tension and falls with the length"
    )
    excitation = "a chirp at several tensions"
    # What swings sags: with the weight fitted, the records' zeros are where the string needs them.
    extends = CableWeight
    inherits: ClassVar[Mapping[str, str]] = {"density_kg_m": "density_kg_m"}
    port = Port.CABLE
    states = 2
    form_error = 0.01
    plain_remedies = (
        limit("the cable's own vibration bounds the bandwidth; shorten or tighten it"),
    )

    coupling: float = parameter(1.0, low=0.0, high=2.0, neutral=0.0)
    density_kg_m: float = parameter(
        0.05,
        low=ABOVE_ZERO,
        unit="kg/m",
        start=_ringing_densities,
        between=(Share(0.01, "ringing_kg_m"), Share(2.5, "ringing_kg_m")),
    )
    damping: float = parameter(0.01, low=1e-3, high=0.5)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        frequency = math.sqrt(plant.tension_N / p.density_kg_m) / (2.0 * plant.length_m)  # (31)
        where = (
            "" if math.isnan(frequency) else f" at {frequency:.3g} Hz ({si(plant.tension_N, 'N')})"
        )
        return (
            f"has a cable of {1e3 * p.density_kg_m:.3g} g/m that swings like a string{where}: "
            f"faster than that, {share(p.coupling)} of its sag's give is lost"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
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
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        v, last = state[0], state[1]
        tension = signal + p.given_N * (v * v - 1.0)
        step = p.keep * last + p.pull * (1.0 - v * (ca.fmax(tension, 0.0) * p.per_preload))
        return ca.vertcat(v + step, step), tension

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """The sag at this tension, and the linear law's tension."""
        v = p.preload_N / ca.fmax(signal, 0.05 * p.preload_N)
        return ca.vertcat(v, 0.0), signal - p.given_N * (v * v - 1.0)
