"""Dahl's bristles, for the effects whose friction is elastic before it slips."""

from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Site

FURTHEST = 1.596071637983322
"""Where 1 - a + a^2/2 - a^3/6 is zero."""


def bent(z: Any, travel: Any) -> Any:
    """How much further the bristles are bent after some travel.

    dz/dx = sign(dx) - z has the solution z -> z exp(-a) + s (1 - exp(-a)) for a travel of size a
    and sign s. Taken is exp(-a) = 1 - a g with g = 1 - a/2 + a^2/6, up to where that is zero: the
    substeps are short, and an exponential in each would cost more than the rest of the trial.

    Args:
        z: How far they are bent before, -1 to 1.
        travel: Signed travel in lengths of the bristles.
    """
    x = ca.fmin(ca.fmax(travel, -FURTHEST), FURTHEST)
    a = ca.fabs(x)
    g = (1.0 - 0.5 * a) + (1.0 / 6.0) * (a * a)
    return g * (x - a * z)


class Bent(NamedTuple):
    """Long and short bristles after a substep.

    Attributes:
        after: How far they are bent, a column of two.
        held: Mean of that before and after, of both: the share of the friction that they hold.
    """

    after: Any
    held: Any


def both_bent(state: Any, site: Site, slowing: Any, bends: tuple[Any, Any]) -> Bent:
    """Two kinds of bristles, that hold half of the friction each, over a substep.

    The angle turned in it is that of the mean velocity with friction's own answer in it, solved to
    first order, so that stiff bristles do not make the drum ring.

    Args:
        state: How far they are bent before, a column of two.
        site: The moment.
        slowing: Half the velocity that the friction takes off in a substep where it slips, rad/s.
        bends: Lengths of either kind that the drum turns in a substep, per velocity.
    """
    z_1, z_2 = state[0], state[1]
    # What the mean velocity would be if the bristles kept their torque.
    share = 0.5 * slowing
    start = 0.5 * site.start_velocity_rad_s - share * (z_1 + z_2)
    unheld = start + 0.5 * site.velocity_rad_s
    way = ca.sign(unheld)
    stiffness = bends[0] * (1.0 - way * z_1) + bends[1] * (1.0 - way * z_2)
    mean = unheld / (1.0 + 0.5 * share * stiffness)
    more_1, more_2 = bent(z_1, mean * bends[0]), bent(z_2, mean * bends[1])
    held = 0.5 * (z_1 + z_2) + 0.25 * (more_1 + more_2)
    return Bent(ca.vertcat(z_1 + more_1, z_2 + more_2), held)
