"""A second mode of the gauge."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, Share, parameter
from plants.effects.plant_scale import PlantScale, digits, share
from plants.effects.remedy import workshop
from plants.simulation.equations import held_input

SQUARINGS = 7
"""Enough for the highest frequency at 100 Hz; see `plants.simulation.equations.held_input`."""


@dataclass(frozen=True)
class GaugeResonance(Effect):
    """A second mode of the gauge beside the reel's: part of the reading goes through it.

        y = (1 - s) T + s g,    g'' + 2 zeta w g' + w^2 g = w^2 T

    Propagated exactly for a tension that is straight from sample to sample.

    Attributes:
        share: Share s of the mode in the reading.
        frequency_Hz: Natural frequency w/(2 pi), Hz.
        damping: Damping ratio zeta.
    """

    name = "gauge_resonance"
    title = "second resonance of the sensor"
    appearance = (
        "the reading rings at a high frequency after each blow while current and angle do not"
    )
    excitation = "a chirp or small steps"
    port = Port.GAUGE
    states = 3
    plain_remedies = (workshop("mount the gauge stiffer, or filter the converter less"),)

    share: float = parameter(0.2, low=0.0, high=1.0, neutral=0.0)
    frequency_Hz: float = parameter(
        150.0,
        low=ABOVE_ZERO,
        unit="Hz",
        between=(Share(3.0, "window_Hz"), Share(2.0, "fastest_Hz")),
    )
    damping: float = parameter(0.03, low=1e-3, high=0.9)

    @classmethod
    def describe(cls, p: Values, _plant: PlantScale) -> str:
        return (
            f"has a gauge with a second resonance, at {digits(p.frequency_Hz)} Hz with a damping "
            f"ratio of {p.damping:.2g}: {share(p.share)} of the reading goes through it and "
            "rings after each blow, while angle and current do not"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Exact propagation over a sample of g - T and g'/w, for a change of T."""
        w = 2.0 * math.pi * p.frequency_Hz
        A, B = ca.SX(2, 2), ca.SX(2, 1)  # the input is the slope of T
        A[0, 1], A[1, 0], A[1, 1] = w, -w, -2.0 * p.damping * w
        B[0] = -1.0
        transition, gamma = held_input(A, B, reel.sample_s, SQUARINGS)
        entries = {f"a{n}{m}": transition[n, m] for n in range(2) for m in range(2)}
        return entries | {"b0": gamma[0] / reel.sample_s, "b1": gamma[1] / reel.sample_s}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        behind, rate, change = state[0], state[1], signal - state[2]
        following = p.a00 * behind + p.a01 * rate + p.b0 * change
        rate = p.a10 * behind + p.a11 * rate + p.b1 * change
        return ca.vertcat(following, rate, signal), signal + p.share * following

    @staticmethod
    def rest(_p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """The mode follows what is steady."""
        return ca.vertcat(0.0, 0.0, signal), signal
