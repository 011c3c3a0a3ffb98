"""A mode of the structure that carries the reel."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.oscillator import stepping
from plants.effects.parameter import ABOVE_ZERO, RecordScale, Share, parameter
from plants.effects.plant_scale import PlantScale, digits, share
from plants.effects.remedy import NOTCH_HARM, Remedy, in_loop, limit, workshop

WIDTH, DEPTH = 0.5, 0.3
"""Width of the notch against it relative to its frequency, and its depth: shallow and wide, as the
mode of a frame moves with the tension. Whether it gains is predicted for each machine."""


def _stiffening_coefficients(records: RecordScale) -> list[float]:
    """None, and that of joints a tenth stiffer at the records' tension."""
    return [] if math.isnan(records.preload_N) else [0.0, 0.1 / records.preload_N]


@dataclass(frozen=True)
class StructuralMode(Effect):
    """An elastic frame in series with the cable, with a mode of its own.

        T = (1 + c) l - q,    q'' + 2 zeta w q' + w^2 (1 + s T) q = w^2 c T

    l is the tension of the linear law, whose stiffness is that of all together: in the end T is l
    where s is zero. q is what the frame's motion takes off the tension of the rest. A frame is
    bolted together, and joints that are pressed harder touch over more of their faces: it may be
    the stiffer, the more the cable pulls.

    Attributes:
        share: Flexibility c of the unloaded frame per that of the rest.
        frequency_Hz: Natural frequency w/(2 pi) of the unloaded frame alone, Hz.
        damping: Damping ratio zeta of the frame alone.
        stiffening_per_N: Growth s of its stiffness with the tension, 1/N.
    """

    name = "structural_mode"
    title = "mode of the structure"
    appearance = (
        "a second resonance in tension, current and angle whose frequency depends "
        "little on length and tension"
    )
    excitation = "a chirp or small steps"
    family = "stiffening"  # one that rings too fast to be seen
    port = Port.CABLE
    states = 2

    share: float = parameter(0.1, low=0.0, high=1.0, neutral=0.0)
    # A slower one is the machine's own motion.
    frequency_Hz: float = parameter(
        60.0,
        low=ABOVE_ZERO,
        unit="Hz",
        between=(Share(0.7, "window_Hz"), Share(1.0, "fastest_Hz")),
    )
    damping: float = parameter(0.05, low=1e-3, high=0.9)
    stiffening_per_N: float = parameter(
        0.0,
        low=0.0,
        unit="1/N",
        start=_stiffening_coefficients,
        between=(Share(0.0), Share(4.0, "per_reading_per_N")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        T = plant.usual_tension_N
        stiffer = "" if plant.is_plant else (
            f" and is {share(p.stiffening_per_N * T)} stiffer at {plant.reading(T)}"
        )  # fmt: skip
        return (
            f"stands on a frame that rings at {digits(p.frequency_Hz)} Hz with a damping ratio of "
            f"{p.damping:.2g} and gives {share(p.share)} as much as the rest does{stiffer}"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        title = "put a notch at the mode in the measurement"
        table = {
            "frequency_Hz": p.frequency_Hz,
            "width_Hz": WIDTH * p.frequency_Hz,
            "depth": DEPTH,
        }
        return (
            in_loop(plant, title, "share", ("mode", table), NOTCH_HARM),
            workshop("stiffen or damp the frame", "share", 1.0),
            limit("the tuner respects the mode already"),
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The frame on the taut cable: 1 + c times as stiff, pulled to c/(1 + c) of the rest."""
        root = ca.sqrt(1.0 + p.share)
        w = 2.0 * math.pi * p.frequency_Hz
        keep, pull = stepping(w * root, p.damping / root, reel.substep_s)
        both = 1.0 / (1.0 + p.share)
        return {
            "settled": p.share * both,
            "stiffer": p.stiffening_per_N * both,
            "keep": keep,
            "pull": pull,
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        q, last = state[0], state[1]
        rest = (1.0 + p.share) * signal
        # With T = max(0, rest - q), T + q is max(rest, q).
        taut = ca.fmax(rest, q)
        goal = p.settled * taut - p.stiffer * (taut - q) * q
        step = p.keep * last + p.pull * (goal - q)
        return ca.vertcat(q + step, step), rest - q

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """Deflection of the frame, and the linear law's tension."""
        q = p.share * signal / (1.0 + p.stiffening_per_N * ca.fmax(signal, 0.0))
        return ca.vertcat(q, 0.0), (signal + q) / (1.0 + p.share)
