"""A second mode of the gauge."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter
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

    name: ClassVar[str] = "gauge_resonance"
    title: ClassVar[str] = "second resonance of the gauge"
    appearance: ClassVar[str] = (
        "the reading rings at a high frequency after each blow while current and angle do not"
    )
    port: ClassVar[Port] = Port.GAUGE
    states: ClassVar[int] = 3

    share: float = parameter(0.2, low=0.0, high=1.0, unit="", neutral=0.0)
    frequency_Hz: float = parameter(150.0, low=20.0, high=2000.0, unit="Hz")
    damping: float = parameter(0.03, low=1e-3, high=0.9, unit="")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """Exact propagation over a sample of g - T and g'/w, for a change of T."""
        w = 2.0 * math.pi * p.frequency_Hz
        A, B = ca.SX(2, 2), ca.SX(2, 1)  # the input is the slope of T
        A[0, 1], A[1, 0], A[1, 1] = w, -w, -2.0 * p.damping * w
        B[0] = -1.0
        transition, gamma = held_input(A, B, reel.sample_s, SQUARINGS)
        entries = {f"a{n}{m}": transition[n, m] for n in range(2) for m in range(2)}
        return entries | {"b0": gamma[0] / reel.sample_s, "b1": gamma[1] / reel.sample_s}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the span is in the numbers prepared
    ) -> tuple[Signal, Signal]:
        """The tension read."""
        behind, rate, change = state[0], state[1], signal - state[2]
        following = p.a00 * behind + p.a01 * rate + p.b0 * change
        rate = p.a10 * behind + p.a11 * rate + p.b1 * change
        return ca.vertcat(following, rate, signal), signal + p.share * following

    @staticmethod
    def rest(
        p: SimpleNamespace,  # noqa: ARG004  the mode has settled
        state: Signal,  # noqa: ARG004  nothing is behind
        signal: Signal,
        site: Site,  # noqa: ARG004  the same anywhere
    ) -> tuple[Signal, Signal]:
        """The mode follows what is steady."""
        return ca.vertcat(0.0, 0.0, signal), signal
