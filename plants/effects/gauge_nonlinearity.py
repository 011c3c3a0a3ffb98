"""A curved gauge."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, digits
from plants.effects.remedy import recalibrate


@dataclass(frozen=True)
class GaugeNonlinearity(Effect):
    """A gauge whose curve is bent: `y = T + c T^2`, a cantilever's second-order calibration curve.

    A curve that bends more at its end than this one changes the slope found at zero, and with it
    the gain of the torque and the inertia, by some per cent.

    Attributes:
        curvature_per_N: The curvature c, 1/N; the curve rises up to a tension of -1/(2 c).
    """

    name = "gauge_nonlinearity"
    title = "nonlinearity of the sensor"
    appearance = (
        "tension read against current is bent while angle against current is straight; "
        "the loop's gain depends on the tension level"
    )
    excitation = "slow ramps over the whole range of tension"
    port = Port.GAUGE
    form_error = 0.05
    plain_remedies = (recalibrate("hang weights and fit C2 with its curve", "curvature_per_N"),)

    curvature_per_N: float = parameter(
        1e-3,
        low=-math.inf,
        unit="1/N",
        neutral=0.0,
        start=Share(0.04, "per_reading_per_N"),
        between=(Share(-0.4, "per_reading_per_N"), Share(0.8, "per_reading_per_N")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        c = p.curvature_per_N
        if plant.is_plant:
            return (
                f"has a gauge whose curve is bent: of an output y it reads {digits(c)} y² too much"
            )
        T = plant.usual_tension_N
        more = "much" if c > 0.0 else "little"
        return (
            f"has a gauge whose curve is bent: at {plant.reading(T)} it reads "
            f"{plant.reading(abs(c) * T * T)} too {more}, at twice that "
            f"{plant.reading(4.0 * abs(c) * T * T)} (curvature {c:.3g} 1/N)"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, signal * (1.0 + p.curvature_per_N * signal)

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The tension that reads so, on the rising part of the curve."""
        root = ca.sqrt(ca.fmax(1.0 + 4.0 * p.curvature_per_N * signal, 0.0))
        return state, 2.0 * signal / (1.0 + root)
