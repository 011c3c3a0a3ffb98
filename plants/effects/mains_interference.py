"""Mains interference in the reading."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, parameter, phase
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import NOTCH_HARM, Remedy, in_loop, workshop

WIDTH_Hz = 3.0
"""Width of the notch against it: with the line off by 1 Hz it still does nearly all, and the mains
of a grid stays within 0.2 Hz."""


@dataclass(frozen=True)
class MainsInterference(Effect):
    """Mains interference in the gauge: `y = T + A sin(2 pi f t + phi)`, t from the start.

    Attributes:
        amplitude_N: Amplitude A, N.
        frequency_Hz: Frequency f, that of the mains or of a harmonic, Hz.
        phase_rad: Phase phi at the start, rad.
    """

    name = "mains_interference"
    title = "mains interference in the sensor"
    appearance = "the reading carries a sine of the mains frequency at rest as well as in motion"
    excitation = "rest for a second or more"
    in_noise = True
    port = Port.GAUGE
    states = 2

    amplitude_N: float = parameter(0.1, low=0.0, unit="N", neutral=0.0)
    frequency_Hz: float = parameter(50.0, low=ABOVE_ZERO, unit="Hz")
    phase_rad: float = phase()

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has mains interference in the gauge's signal: {plant.reading(p.amplitude_N)} at "
            f"{p.frequency_Hz:.4g} Hz, at rest as well as in motion"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        shield = workshop("shield the gauge's cable, ground it at one end", "amplitude_N", 1.0)
        table = {"frequency_Hz": p.frequency_Hz, "width_Hz": WIDTH_Hz}
        title = "put a notch at the line in the measurement"
        return (in_loop(plant, title, "amplitude_N", ("hum", table), NOTCH_HARM), shield)

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The turn of the phase in a sample."""
        turn = 2.0 * math.pi * p.frequency_Hz * reel.sample_s
        return {"cosine": ca.cos(turn), "sine": ca.sin(turn)}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The reading with the interference; the state is the wave and its quadrature."""
        wave, quadrature = state[0], state[1]
        turned = ca.vertcat(
            p.cosine * wave + p.sine * quadrature, p.cosine * quadrature - p.sine * wave
        )
        return turned, signal + p.amplitude_N * wave

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """The wave at its phase; a trial starts settled but for it."""
        return ca.vertcat(ca.sin(p.phase_rad), ca.cos(p.phase_rad)), signal
