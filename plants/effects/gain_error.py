"""A wrong gain of the drive."""

from dataclasses import dataclass

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, share
from plants.effects.remedy import recalibrate


@dataclass(frozen=True)
class GainError(Effect):
    """A drive that gives more or less current, or torque, than commanded: `i = (1 + e) u`.

    Attributes:
        error: The relative error e.
    """

    name = "gain_error"
    title = "gain error of the drive"
    appearance = (
        "command and measurement stand in another ratio than the model's, at rest as well "
        "as in motion"
    )
    excitation = "rest at several levels"
    base_parameter = "torque_gain"
    port = Port.ACTUATOR
    plain_remedies = (
        recalibrate(
            "correct C1, or the torque constant by a weight that the motor just holds", "error"
        ),
    )

    # Uncertainty of any drive's torque constant.
    error: float = parameter(0.05, low=-0.5, high=1.0, neutral=0.0, least=(Share(0.04),))

    @classmethod
    def describe(cls, p: Values, _plant: PlantScale) -> str:
        more = "more" if p.error > 0.0 else "less"
        return (
            f"has a drive that gives {share(abs(p.error))} {more} torque than the model says, at "
            "rest as well as in motion"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, (1.0 + p.error) * signal

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        return state, signal / (1.0 + p.error)
