"""Quantisation of the reading."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import workshop

FINEST_N = 1e-12


@dataclass(frozen=True)
class Quantisation(Effect):
    """A gauge read in steps, as by a coarse converter: `y = q floor(T/q + 1/2)`.

    Attributes:
        step_N: The step q, N; the reel's own gauge has none.
    """

    name = "quantisation"
    title = "quantisation of the sensor"
    appearance = "the reading takes few values, and at rest jumps between two of them"
    excitation = "rest and slow ramps"
    in_noise = True
    port = Port.GAUGE
    smooth = False
    plain_remedies = (
        workshop("use a converter of more bits, or less of its range", "step_N", 1.0),
    )

    step_N: float = parameter(0.1, low=0.0, unit="N", neutral=0.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return f"has a gauge that reads in steps of {plant.reading(p.step_N)}"

    @staticmethod
    def prepare(p: Values, _reel: Values) -> dict[str, Signal]:
        """The step, and steps per newton; a step of zero is taken as one too small to see."""
        step = ca.fmax(p.step_N, FINEST_N)
        return {"step": step, "per_N": 1.0 / step}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, p.step * ca.floor(signal * p.per_N + 0.5)
