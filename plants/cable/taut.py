"""A cable that is nearly straight: when it counts as taut, its density under load, its notes."""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import Numbers, at, checked, first, plain
from estune.errors import InvalidInput

GRAVITY_M_S2 = 9.80665
"""Standard gravity, ISO 80000-3."""


def tension_ratio(
    density_kg_m: ArrayLike,
    length_m: ArrayLike,
    tension_1_N: ArrayLike,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> Numbers:
    """The relative tension differential ratio, the cable's weight over its tension.

    A cable may be taken for a straight, weightless line where the ratio is at most beta << 1; see
    `least_taut_tension_N`.

    Args:
        density_kg_m: Mass per length mu, kg/m, above zero; any shape.
        length_m: Length of the cable ds, m, above zero.
        tension_1_N: Tension at the attachment |T_1|, N, above zero.
        gravity_m_s2: Gravitational acceleration, m/s2.

    Raises:
        InvalidInput: a value is not finite or not above zero.
    """
    mu = checked("density", density_kg_m, "kg/m", above=0.0)
    s = checked("length", length_m, "m", above=0.0)
    T_1 = checked("tension_1", tension_1_N, "N", above=0.0)
    g = checked("gravity", gravity_m_s2, "m/s2", above=0.0)
    return plain(np.asarray(mu * g * s / T_1))


def least_taut_tension_N(
    rest_density_kg_m: ArrayLike,
    length_m: ArrayLike,
    beta: ArrayLike = 0.05,
    stiffness_EA_N: ArrayLike | None = None,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> Numbers:
    """Least tension at which the cable is a straight line: `|T_1| >= mu g ds / beta`, N.

    Implements (1).

    With a stiffness, mu is the density (2) at that very tension, so that
    `T + T^2/EA = mu_0 g ds / beta`, and the positive root is returned: the least tension a
    distribution of tensions over several cables may ask for.

    Args:
        rest_density_kg_m: Mass per length of the unloaded cable mu_0, kg/m; any shape.
        length_m: Length of the cable ds, m.
        beta: Criterion; far below one. 0.05 keeps the tension uniform within 5 %.
        stiffness_EA_N: Young's modulus times section EA, N; None for a cable that does not
            stretch.
        gravity_m_s2: Gravitational acceleration, m/s2.

    Raises:
        InvalidInput: a value is not finite or not above zero, or beta is one or more.
    """
    mu_0 = checked("rest density", rest_density_kg_m, "kg/m", above=0.0)
    s = checked("length", length_m, "m", above=0.0)
    criterion = checked("beta", beta, "", above=0.0)
    g = checked("gravity", gravity_m_s2, "m/s2", above=0.0)
    if (criterion >= 1.0).any():
        place = first(criterion >= 1.0)
        raise InvalidInput(
            f"beta is {criterion[place]:g}{at(place)}; a taut cable needs beta far below 1"
        )
    bound = np.asarray(mu_0 * g * s / criterion)
    if stiffness_EA_N is None:
        return plain(bound)
    EA = checked("stiffness EA", stiffness_EA_N, "N", above=0.0)
    # The root of T^2 + EA T - EA bound that does not cancel for a stiff cable.
    return plain(np.asarray(2.0 * bound / (1.0 + np.sqrt(1.0 + 4.0 * bound / EA))))


def loaded_density_kg_m(
    rest_density_kg_m: ArrayLike, tension_1_N: ArrayLike, stiffness_EA_N: ArrayLike
) -> Numbers:
    """Mass per length of the cable under tension, `mu = mu_0 / (1 + |T_1|/EA)`, kg/m.

    Implements (2).

    Exact where the tension is the same all along; for a sagging cable it takes the tension at
    the attachment for all of it, and `elastic_catenary` is the exact form.

    Args:
        rest_density_kg_m: Mass per length of the unloaded cable mu_0, kg/m; any shape.
        tension_1_N: Tension at the attachment |T_1|, N, zero or above.
        stiffness_EA_N: Young's modulus times section EA, N.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    mu_0 = checked("rest density", rest_density_kg_m, "kg/m", above=0.0)
    T_1 = checked("tension_1", tension_1_N, "N", least=0.0)
    EA = checked("stiffness EA", stiffness_EA_N, "N", above=0.0)
    return plain(np.asarray(mu_0 / (1.0 + T_1 / EA)))


def string_frequency_Hz(
    density_kg_m: ArrayLike,
    length_m: ArrayLike,
    tension_1_N: ArrayLike,
    order: ArrayLike = 1,
) -> Numbers:
    """Natural frequency of the cable as a string fixed at both ends, Hz.

    Implements (31).

    `f_n = n / (2 ds) sqrt(|T_1| / mu)`, for a taut cable without bending stiffness. The text after
    the equation in the paper speaks of "the square of the tension" and means its square root.

    Args:
        density_kg_m: Mass per length mu, kg/m; any shape.
        length_m: Length of the cable ds, m.
        tension_1_N: Tension after the eyelet |T_1|, N.
        order: Which mode n, 1 is the lowest; a whole number.

    Raises:
        InvalidInput: a value is not finite or not above zero, or the order is not whole.
    """
    mu = checked("density", density_kg_m, "kg/m", above=0.0)
    s = checked("length", length_m, "m", above=0.0)
    T_1 = checked("tension_1", tension_1_N, "N", above=0.0)
    n = checked("order", order, "", above=0.0)
    if (n != np.rint(n)).any():
        place = first(n != np.rint(n))
        raise InvalidInput(f"order is {n[place]:g}{at(place)}; modes are numbered 1, 2, 3...")
    return plain(np.asarray(n / (2.0 * s) * np.sqrt(T_1 / mu)))
