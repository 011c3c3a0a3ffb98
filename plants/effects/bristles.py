"""Dahl's bristles, for the effects whose friction is elastic before it slips."""

from typing import Any

import casadi as ca

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
