"""Torque that depends on the drum's angle."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects import angle_phase
from plants.effects.effect import Effect, Port, Signal, Site, WINDS_rad, parameter


@dataclass(frozen=True)
class TorqueRipple(Effect):
    """Cogging of the motor: `tau = -A sin(N theta + phi)`.

    Attributes:
        amplitude_Nm: Amplitude A, N m.
        per_turn: Periods N in a turn of the drum.
        phase_rad: Phase phi where the cable is just taut, or the encoder reads zero, rad.
    """

    name: ClassVar[str] = "torque_ripple"
    title: ClassVar[str] = "torque ripple of the motor"
    appearance: ClassVar[str] = (
        "current and tension differ by a wave over the angle, the same at each passage "
        "whatever the velocity"
    )
    port: ClassVar[Port] = Port.DRUM
    states: ClassVar[int] = angle_phase.STATES
    repeats: ClassVar[str] = "per_turn"

    amplitude_Nm: float = parameter(0.01, low=0.0, high=1e3, unit="N m", neutral=0.0)
    per_turn: float = parameter(24.0, low=3.0, high=1e4, unit="")
    phase_rad: float = parameter(0.0, low=-WINDS_rad, high=WINDS_rad, unit="rad")

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,  # noqa: ARG004  it does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The torque at this angle."""
        phase = angle_phase.advance_angle(state, p.per_turn * site.angle_rad + p.phase_rad)
        return phase, -p.amplitude_Nm * phase[0]

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the phase
        signal: Signal,  # noqa: ARG004  it does not depend on the torque of other effects
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The same at the angle of rest."""
        phase = angle_phase.encode_angle(p.per_turn * site.angle_rad + p.phase_rad)
        return phase, -p.amplitude_Nm * phase[0]

    @staticmethod
    def put(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the phase
        angle_rad: Signal,
    ) -> Signal:
        """The phase there."""
        return angle_phase.encode_angle(p.per_turn * angle_rad + p.phase_rad)
