"""Friction in proportion to velocity."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

from plants.effects.effect import Effect, Port, parameter


@dataclass(frozen=True)
class ViscousDamping(Effect):
    """More viscous friction at the drum than the reel has of itself: `tau = -b omega`.

    It joins the reel's own friction and is propagated exactly with it.

    Attributes:
        damping_Nms: The friction b added, N m s/rad.
    """

    name: ClassVar[str] = "viscous_damping"
    title: ClassVar[str] = "viscous friction of the drum"
    appearance: ClassVar[str] = (
        "current and tension differ in proportion to the velocity; "
        "the resonance is lower and wider than the model's"
    )
    port: ClassVar[Port] = Port.DRUM

    damping_Nms: float = parameter(0.01, low=0.0, high=1e4, unit="N m s/rad", neutral=0.0)

    @staticmethod
    def amend(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Any]:
        """The friction of reel and effect together."""
        return {"viscous_friction_Nms": reel.viscous_friction_Nms + p.damping_Nms}
