"""Linear plants from torque to angle, to which effects are added; see `linear_with_effects`."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar, NamedTuple, Protocol

import casadi as ca

from plants.simulation.equations import Expression


class Motion(NamedTuple):
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


class LinearBase(Protocol):
    """Kind of linear plant; hashable."""

    @property
    def own(self) -> tuple[str, ...]:
        """Names of its parameters."""
        ...

    @property
    def order(self) -> int:
        """Number of its states."""
        ...

    @property
    def is_drum(self) -> bool:
        """Whether an encoder reads its output as an angle; otherwise a gauge reads it."""
        ...

    @property
    def can_rest(self) -> bool:
        """Whether it can be at rest at an output other than zero."""
        ...

    def motion(self, p: SimpleNamespace) -> Motion:
        """The plant for its parameters by name, as amended by effects."""
        ...


@dataclass(frozen=True, slots=True)
class Drum:
    """A drum without a cable, torque in and angle out: `J theta'' + b theta' = tau`."""

    own: ClassVar[tuple[str, ...]] = (
        "drum_radius_m",
        "drum_inertia_kg_m2",
        "viscous_friction_Nms",
        "torque_constant_Nm_A",
    )
    order: ClassVar[int] = 2
    is_drum: ClassVar[bool] = True
    can_rest: ClassVar[bool] = True

    def motion(self, p: SimpleNamespace) -> Motion:
        """The states are angle and velocity."""
        A, B, C, V = ca.SX(2, 2), ca.SX(2, 1), ca.SX(1, 2), ca.SX(1, 2)
        A[0, 1], A[1, 1] = 1.0, -p.viscous_friction_Nms / p.drum_inertia_kg_m2
        B[1] = 1.0 / p.drum_inertia_kg_m2
        C[0], V[1] = 1.0, 1.0
        return Motion(A, B, C, ca.SX(0.0), V, ca.SX(0.0))
