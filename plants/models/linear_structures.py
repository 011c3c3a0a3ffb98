"""Linear plants from torque to angle, to which effects are added; see `linear_with_effects`."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar, NamedTuple

import casadi as ca

from plants.simulation.equations import Expression


class MotionStateSpace(NamedTuple):
    """State space of a linear plant from torque to angle, in numbers or symbols."""

    A: Expression  # state matrix, 1/s
    B: Expression  # input vector
    C: Expression  # output row
    E: Expression  # direct feed-through
    # Row of the output's derivative; None where the output jumps with the input.
    V: Expression | None
    # Torque that holds the output at one: 1/G(0), zero of a plant that integrates, None where the
    # plant has no rest but at zero.
    restoring: Expression | None


@dataclass(frozen=True, slots=True)
class DrumStructure:
    """A drum without a cable, torque in and angle out: `J theta'' + b theta' = tau`."""

    own: ClassVar[tuple[str, ...]] = (
        "drum_radius_m",
        "drum_inertia_kg_m2",
        "viscous_friction_Nms",
        "torque_constant_Nm_A",
    )
    order: ClassVar[int] = 2
    is_drum: ClassVar[bool] = True  # an encoder reads the output as an angle
    can_rest: ClassVar[bool] = True  # at an output other than zero

    def motion(self, p: SimpleNamespace) -> MotionStateSpace:
        """The states are angle and velocity."""
        A, B, C, V = ca.SX(2, 2), ca.SX(2, 1), ca.SX(1, 2), ca.SX(1, 2)
        A[0, 1], A[1, 1] = 1.0, -p.viscous_friction_Nms / p.drum_inertia_kg_m2
        B[1] = 1.0 / p.drum_inertia_kg_m2
        C[0], V[1] = 1.0, 1.0
        return MotionStateSpace(A, B, C, ca.SX(0.0), V, ca.SX(0.0))
