"""Friction in proportion to velocity."""

from dataclasses import dataclass
from typing import Any

from plants.effects.effect import Effect, Port, Values
from plants.effects.parameter import parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, limit


@dataclass(frozen=True)
class ViscousDamping(Effect):
    """More viscous friction at the drum than the reel has of itself: `tau = -b omega`.

    It joins the reel's own friction and is propagated exactly with it.

    Attributes:
        damping_Nms: The friction b added, N m s/rad.
    """

    name = "viscous_damping"
    title = "viscous friction"
    appearance = (
        "motion takes an effort in proportion to its velocity; the resonance is lower and "
        "wider than the model's"
    )
    excitation = "fast motion in both directions"
    base_parameter = "viscous_friction_Nms"
    port = Port.DRUM

    damping_Nms: float = parameter(0.01, low=0.0, unit="N m s/rad", neutral=0.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        """Sentence with the fitted values."""
        return (
            f"has more viscous friction than the model: {plant.damping(p.damping_Nms)}, in "
            "proportion to the speed"
        )

    @classmethod
    def remedies(cls, _p: Values, _plant: PlantScale) -> tuple[Remedy, ...]:
        """What can be done about it."""
        return (limit("the loop is tuned with it; it damps, and costs nothing in tracking"),)

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        """The friction of reel and effect together."""
        return {"viscous_friction_Nms": reel.viscous_friction_Nms + p.damping_Nms}
