"""Torque that depends on the drum's angle."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class TorqueRipple(Effect):
    """Cogging of the motor: `tau = -A sin(N theta + phi)`.

    Attributes:
        amplitude_Nm: Amplitude A, N m.
        per_turn: Periods N in a turn of the drum.
        phase_rad: Phase phi where the cable is just taut, rad.
    """

    name: ClassVar[str] = "torque_ripple"
    title: ClassVar[str] = "torque ripple of the motor"
    appearance: ClassVar[str] = (
        "current and tension differ by a wave over the angle, the same at each passage "
        "whatever the velocity"
    )
    port: ClassVar[Port] = Port.DRUM

    amplitude_Nm: float = parameter(0.01, low=0.0, high=0.5, unit="N m", neutral=0.0)
    per_turn: float = parameter(24.0, low=1.0, high=300.0, unit="")
    phase_rad: float = parameter(0.0, low=-math.pi, high=math.pi, unit="rad")

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  it does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The torque at this angle."""
        return state, -p.amplitude_Nm * ca.sin(p.per_turn * site.angle_rad + p.phase_rad)

    @staticmethod
    def rest(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The same: it depends on the angle alone."""
        return TorqueRipple.respond(p, state, signal, site)
