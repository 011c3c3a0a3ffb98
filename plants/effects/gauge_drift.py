"""Drift of the gauge's zero."""

import math
from dataclasses import dataclass

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import workshop


@dataclass(frozen=True)
class GaugeDrift(Effect):
    """A gauge whose zero moves steadily, as with temperature: `y = T + r t`, t from the start.

    Attributes:
        rate_N_per_s: The rate r, N/s.
    """

    name = "gauge_drift"
    title = "drift of the sensor"
    appearance = (
        "tension read and current move apart in proportion to the time, at any motion; "
        "the first and last rest of a record disagree"
    )
    excitation = "a long record that begins and ends at rest"
    port = Port.GAUGE
    states = 1
    plain_remedies = (
        workshop("let the gauge warm up, and tare it before each trial", "rate_N_per_s", 1.0),
    )

    rate_N_per_s: float = parameter(
        0.1,
        low=-math.inf,
        unit="N/s",
        neutral=0.0,
        start=Share(0.03, "reading_rate_N_s"),
        between=(Share(-2.0, "reading_rate_N_s"), Share(2.0, "reading_rate_N_s")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        rate = p.rate_N_per_s
        return (
            f"has a gauge whose zero wanders {'up' if rate > 0.0 else 'down'} from the start of a "
            f"record: {plant.reading(abs(rate))} in a second"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The tension read; the state is the drift."""
        return state + p.rate_N_per_s * site.span_s, signal + state
