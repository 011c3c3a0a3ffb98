"""First-order lag of the current loop."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, digits, si
from plants.effects.remedy import workshop

TINY_s = 1e-15
"""Keeps a quotient finite where there is no lag."""


@dataclass(frozen=True)
class CurrentLag(Effect):
    """A current that follows its command with a first-order lag: `t di/dt = u - i`.

    Over a sample of length h, in which the command u is held, what acts is the mean current:

        i_end = u + (i - u) e,    mean i = u + (i - u) (1 - e) t/h,    e = exp(-h/t)

    Attributes:
        lag_s: Time constant t, s.
    """

    name = "current_lag"
    title = "lag of the current loop"
    appearance = (
        "slow changes of the command come late by the time constant, fast ones are also smaller"
    )
    excitation = "a multisine up to several times the loop's bandwidth"
    family = "delay of the drive"
    port = Port.ACTUATOR
    states = 1
    plain_remedies = (
        workshop("raise the bandwidth of the amplifier's current loop", "lag_s", 1.0),
    )

    lag_s: float = parameter(
        2e-3,
        low=0.0,
        unit="s",
        neutral=0.0,
        start=Share(1.0, "sample_s"),
        between=(Share(0.0), Share(0.5, "record_s")),
        least=(Share(0.2, "sample_s"),),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:  # noqa: ARG003  a time
        corner_Hz = 1.0 / (2.0 * ca.pi * max(p.lag_s, TINY_s))
        return (
            f"has a drive whose current follows its command with a lag of {si(p.lag_s, 's')}: it "
            f"gives 0.71 of what is commanded at {digits(corner_Hz)} Hz"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The current that is reached within the sample, and its mean on the way."""
        lag = p.lag_s + TINY_s
        kept = ca.exp(-site.span_s / lag)
        rest = state - signal
        return signal + rest * kept, signal + rest * (1.0 - kept) * lag / site.span_s

    @staticmethod
    def rest(_p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        return signal, signal
