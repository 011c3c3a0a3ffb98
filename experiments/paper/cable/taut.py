"""A nearly straight cable: taut criterion, density under load, string frequency.

Arguments are arrays of any shape in the units of their names: rest density mu_0, density mu,
length ds, tension at the attachment |T_1|, and stiffness EA, Young's modulus times cross-section.
All functions raise InvalidInput for values that are not finite or out of their range.
"""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import Numbers, checked_array, refuse_where, scalar_or_array
from plants.models.path_structure import GRAVITY_M_S2


def least_taut_tension_N(
    rest_density_kg_m: ArrayLike,
    length_m: ArrayLike,
    beta: ArrayLike = 0.05,
    stiffness_EA_N: ArrayLike | None = None,
) -> Numbers:
    """Least tension at which the cable is a straight line: `|T_1| >= mu g ds / beta`, N.

    Implements (1).

    With a stiffness, mu is the density (2) at the least tension itself, so that
    `T + T^2/EA = mu_0 g ds / beta`, of which the positive root is returned. The criterion beta is
    far below one; 0.05 keeps the tension uniform within 5 %.
    """
    mu_0 = checked_array("rest density", rest_density_kg_m, "kg/m", above=0.0)
    s = checked_array("length", length_m, "m", above=0.0)
    criterion = checked_array("beta", beta, "", above=0.0)
    remedy = "a taut cable needs beta far below 1"
    refuse_where(criterion >= 1.0, "beta", criterion, "", remedy)
    bound = np.asarray(mu_0 * GRAVITY_M_S2 * s / criterion)
    if stiffness_EA_N is None:
        return scalar_or_array(bound)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    # The root of T^2 + EA T - EA bound in a form without cancellation for a stiff cable.
    return scalar_or_array(np.asarray(2.0 * bound / (1.0 + np.sqrt(1.0 + 4.0 * bound / EA))))


def loaded_density_kg_m(
    rest_density_kg_m: ArrayLike, tension_1_N: ArrayLike, stiffness_EA_N: ArrayLike
) -> Numbers:
    """Mass per length of the cable under tension, `mu = mu_0 / (1 + |T_1|/EA)`, kg/m.

    Implements (2).

    Exact for a uniform tension.
    """
    mu_0 = checked_array("rest density", rest_density_kg_m, "kg/m", above=0.0)
    T_1 = checked_array("tension_1", tension_1_N, "N", least=0.0)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    return scalar_or_array(np.asarray(mu_0 / (1.0 + T_1 / EA)))


def string_frequency_Hz(
    density_kg_m: ArrayLike,
    length_m: ArrayLike,
    tension_1_N: ArrayLike,
    order: ArrayLike = 1,
) -> Numbers:
    """Natural frequency of the cable as a string fixed at both ends, Hz.

    Implements (31).

    `f_n = n / (2 ds) sqrt(|T_1| / mu)`, for a taut cable without bending stiffness. Where the
    paper's text says "the square of the tension", it means the square root. The order n counts
    from 1.
    """
    mu = checked_array("density", density_kg_m, "kg/m", above=0.0)
    s = checked_array("length", length_m, "m", above=0.0)
    T_1 = checked_array("tension_1", tension_1_N, "N", above=0.0)
    n = checked_array("order", order, "", above=0.0)
    refuse_where(n != np.rint(n), "order", n, "", "modes are numbered 1, 2, 3...")
    return scalar_or_array(np.asarray(n / (2.0 * s) * np.sqrt(T_1 / mu)))
