"""Hum of the mains in the reading."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, WINDS_rad, parameter


@dataclass(frozen=True)
class MainsInterference(Effect):
    """Hum in the gauge's signal: `y = T + A sin(2 pi f t + phi)`, t from the start of the trial.

    Attributes:
        amplitude_N: Amplitude A, N.
        frequency_Hz: Frequency f, that of the mains or of a harmonic, Hz.
        phase_rad: Phase phi at the start, rad.
    """

    name: ClassVar[str] = "mains_interference"
    title: ClassVar[str] = "mains hum in the gauge"
    appearance: ClassVar[str] = (
        "the reading carries a sine of the mains frequency at rest as well as in motion"
    )
    port: ClassVar[Port] = Port.GAUGE
    states: ClassVar[int] = 2

    amplitude_N: float = parameter(0.1, low=0.0, high=10.0, unit="N", neutral=0.0)
    frequency_Hz: float = parameter(50.0, low=10.0, high=300.0, unit="Hz")
    phase_rad: float = parameter(0.0, low=-WINDS_rad, high=WINDS_rad, unit="rad")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The turn of the phase in a sample."""
        turn = 2.0 * math.pi * p.frequency_Hz * reel.sample_s
        return {"cosine": ca.cos(turn), "sine": ca.sin(turn)}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the span is in the numbers prepared
    ) -> tuple[Signal, Signal]:
        """The reading with its hum; what is remembered is the wave and its quadrature."""
        wave, quadrature = state[0], state[1]
        turned = ca.vertcat(
            p.cosine * wave + p.sine * quadrature, p.cosine * quadrature - p.sine * wave
        )
        return turned, signal + p.amplitude_N * wave

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the phase
        signal: Signal,
        site: Site,  # noqa: ARG004  the same at any angle
    ) -> tuple[Signal, Signal]:
        """The wave at its phase; a trial starts settled but for the hum."""
        return ca.vertcat(ca.sin(p.phase_rad), ca.cos(p.phase_rad)), signal
