"""A shifted zero of the gauge."""

import math
from dataclasses import dataclass

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import recalibrate


@dataclass(frozen=True)
class GaugeOffset(Effect):
    """A gauge that reads the same amount too much at any tension: `y = T + T_0`.

    Attributes:
        offset_N: The amount T_0, N.
    """

    name = "gauge_offset"
    title = "zero offset of the sensor"
    appearance = (
        "tension read and current differ by a constant that no motion changes, "
        "and the cable is slack at a reading other than zero"
    )
    excitation = "rest with a slack cable"
    base_parameter = "gauge_offset_N"
    port = Port.GAUGE
    plain_remedies = (recalibrate("tare the gauge: C2 without tension", "offset_N"),)

    # Uncertainty of any gauge's zero: a hundredth of its readings.
    offset_N: float = parameter(
        0.5,
        low=-math.inf,
        unit="N",
        neutral=0.0,
        start=Share(0.01, "reading_max_N"),
        between=(Share(-0.5, "reading_max_N"), Share(0.5, "reading_max_N")),
        least=(Share(3.0, "tension_noise_N"), Share(0.01, "reading_max_N")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        more = "much" if p.offset_N > 0.0 else "little"
        return f"has a gauge that reads {plant.reading(abs(p.offset_N))} too {more} at any tension"

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, signal + p.offset_N

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, signal - p.offset_N
