"""Friction in proportion to velocity."""

from dataclasses import dataclass
from typing import Any

from plants.effects.effect import Effect, Port, Values
from plants.effects.parameter import parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import limit


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
    plain_remedies = (limit("the loop is tuned with it; it damps, and costs nothing in tracking"),)

    damping_Nms: float = parameter(0.01, low=0.0, unit="N m s/rad", neutral=0.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has more viscous friction than the model: {plant.damping(p.damping_Nms)}, in "
            "proportion to the speed"
        )

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        return {"viscous_friction_Nms": reel.viscous_friction_Nms + p.damping_Nms}
