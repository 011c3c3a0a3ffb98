"""A mode of what carries the reel."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter
from plants.effects.oscillator import stepping


@dataclass(frozen=True)
class StructuralMode(Effect):
    """A frame that gives and rings under the cable's pull, in series with the cable.

        T = (1 + c) l - q,    q'' + 2 zeta w q' + w^2 q = w^2 c T

    l is the tension of the linear law, whose stiffness is that of all together: in the end T is l.
    q is what the frame's motion takes off the tension of the rest.

    Attributes:
        share: Flexibility c of the frame per that of the rest.
        frequency_Hz: Natural frequency w/(2 pi) of the frame alone, Hz.
        damping: Damping ratio zeta of the frame alone.
    """

    name: ClassVar[str] = "structural_mode"
    title: ClassVar[str] = "mode of the structure"
    appearance: ClassVar[str] = (
        "a second resonance in tension, current and angle whose frequency depends "
        "little on length and tension"
    )
    port: ClassVar[Port] = Port.CABLE
    states: ClassVar[int] = 2

    share: float = parameter(0.1, low=0.0, high=1.0, unit="", neutral=0.0)
    frequency_Hz: float = parameter(60.0, low=5.0, high=250.0, unit="Hz")
    damping: float = parameter(0.02, low=1e-3, high=0.9, unit="")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The frame on the taut cable: 1 + c times as stiff, pulled to c/(1 + c) of the rest."""
        root = ca.sqrt(1.0 + p.share)
        w = 2.0 * math.pi * p.frequency_Hz
        keep, pull = stepping(w * root, p.damping / root, reel.substep_s)
        return {"settled": p.share / (1.0 + p.share), "keep": keep, "pull": pull}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the span is in the numbers prepared
    ) -> tuple[Signal, Signal]:
        """The tension left."""
        q, last = state[0], state[1]
        rest = (1.0 + p.share) * signal
        goal = p.settled * ca.fmax(rest, q)  # with T = max(0, rest - q), T + q is max(rest, q)
        step = p.keep * last + p.pull * (goal - q)
        return ca.vertcat(q + step, step), rest - q

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is what the frame gives
        signal: Signal,
        site: Site,  # noqa: ARG004  the same at any angle
    ) -> tuple[Signal, Signal]:
        """What the frame gives; the tension is the linear law's."""
        return ca.vertcat(p.share * signal, 0.0), signal
