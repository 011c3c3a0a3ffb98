"""Dahl's bristle model, for friction that is elastic before it slips."""

from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Site
from plants.effects.parameter import Share

FURTHEST = 1.596071637983322
"""Root of 1 - a + a^2/2 - a^3/6."""

PRESLIDING = (Share(1e-7, "angle_rms_rad"), Share(2.0, "angle_rms_rad"))
"""Bounds of a fit of the lengths of bristles."""


def bent(z: Any, travel: Any) -> Any:
    """Change of the deflection z, -1 to 1, over a signed travel in lengths of the bristles.

    dz/dx = sign(dx) - z has the solution z -> z exp(-a) + s (1 - exp(-a)) for a travel of size a
    and sign s. Used is exp(-a) = 1 - a g with g = 1 - a/2 + a^2/6, up to where that is zero: an
    exponential in each substep would cost more than the rest of the trial.
    """
    x = ca.fmin(ca.fmax(travel, -FURTHEST), FURTHEST)
    a = ca.fabs(x)
    g = (1.0 - 0.5 * a) + (1.0 / 6.0) * (a * a)
    return g * (x - a * z)


class Bent(NamedTuple):
    """Deflections after a substep, a column of two, and their mean over it, the friction."""

    after: Any
    held: Any


def both_bent(state: Any, site: Site, slowing: Any, bends: tuple[Any, Any]) -> Bent:
    """Two kinds of bristles, each with half of the friction, over a substep.

    The angle of the substep is that of the mean velocity including friction, solved to first
    order, so that stiff bristles do not make the drum oscillate.

    Args:
        state: Deflections before, a column of two.
        site: The substep.
        slowing: Half the velocity that the friction takes off in a substep where it slips, rad/s.
        bends: Lengths of either kind that the drum turns in a substep, per velocity.
    """
    z_1, z_2 = state[0], state[1]
    # Mean velocity with the torque of the bristles held.
    share = 0.5 * slowing
    start = 0.5 * site.start_velocity_rad_s - share * (z_1 + z_2)
    unheld = start + 0.5 * site.velocity_rad_s
    way = ca.sign(unheld)
    stiffness = bends[0] * (1.0 - way * z_1) + bends[1] * (1.0 - way * z_2)
    mean = unheld / (1.0 + 0.5 * share * stiffness)
    more_1, more_2 = bent(z_1, mean * bends[0]), bent(z_2, mean * bends[1])
    held = 0.5 * (z_1 + z_2) + 0.25 * (more_1 + more_2)
    return Bent(ca.vertcat(z_1 + more_1, z_2 + more_2), held)
