"""The attenuation ratio B of a contact, from the friction coefficient C_R and back.

A cable that slides in over an eyelet has `|T_1| = B |T_2|` outside. With `u = -ln B`, (21) is
`sinh(u/2) = C_R / sqrt(1 - C_R^2) cos(gamma/2)`: u is what adds up over several contacts, and the
form neither cancels for a cable that is almost straight nor for little friction.
"""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, Numbers, index_text, checked_array, first_index, scalar_or_array
from estune.errors import InvalidInput
from plants.cable.roots import newton
from plants.two_reel_bench.contact import checked_angle, contact_force_N, friction_N

LEAST_BEND_rad = 1e-6
"""A cable that is straighter than this tells nothing of friction."""


def sliding_excess_N(
    tension_1_N: ArrayLike,
    tension_2_N: ArrayLike,
    coefficient_R: ArrayLike,
    angle_rad: ArrayLike,
) -> Numbers:
    """By how much the difference of the tensions exceeds what friction can hold, N.

    Implements (21).

    `|T_2| - |T_1| - C_R sqrt(|T_1|^2 + |T_2|^2 + 2 |T_1||T_2| cos gamma)`: zero where the cable
    slides in or is about to, below zero where it sticks.

    Args:
        tension_1_N: Tension outside |T_1|, N; any shape.
        tension_2_N: Tension inside |T_2|, N; broadcasts.
        coefficient_R: Friction coefficient C_R; broadcasts.
        angle_rad: Angle gamma between the tensions; broadcasts.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    contact = contact_force_N(tension_1_N, tension_2_N, angle_rad)
    held = friction_N(contact, coefficient_R)
    return scalar_or_array(np.asarray(np.asarray(tension_2_N) - np.asarray(tension_1_N) - held))


def capital_gamma(coefficient_R: ArrayLike, angle_rad: ArrayLike) -> Numbers:
    """The coefficient Gamma of the quadratic equation (22).

    Implements (25).

    `Gamma = (1 + C_R^2 cos gamma) / (1 - C_R^2)`, 1 or more for C_R below one. From one on, the
    friction on a folded cable exceeds any tension, and the contact jams.

    Args:
        coefficient_R: Friction coefficient C_R, from 0 to below 1; any shape.
        angle_rad: Angle gamma, 0 to pi; broadcasts.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    C, gamma = checked_coefficient(coefficient_R), checked_angle(angle_rad)
    # 1 + 2 sinh^2(u/2): the printed quotient, without losing Gamma - 1.
    return scalar_or_array(np.asarray(1.0 + 2.0 * (_tangent(C) * np.cos(0.5 * gamma)) ** 2))


def attenuation(coefficient_R: ArrayLike, *angles_rad: ArrayLike) -> Numbers:
    """Attenuation ratio B of a reel with one contact or several of the same coefficient.

    Implements (22) and (24).

    `|T_1|^2 + |T_2|^2 - 2 |T_1||T_2| Gamma = 0` has the roots `B = Gamma - sqrt(Gamma^2 - 1)` and
    its inverse. The text dismisses the other one for `B >= 0`, but both are above zero: it is the
    ratio of a cable that is paid out, `|T_1| > |T_2|`, which (15) rules out. With several
    contacts, their product (26).

    Args:
        coefficient_R: Friction coefficient C_R, from 0 to below 1; any shape.
        *angles_rad: Angle gamma between the tensions of each contact, 0 (folded back) to pi
            (straight); broadcast.

    Returns:
        B, above 0, at most 1.

    Raises:
        InvalidInput: a value is not finite or out of its range, or no angle is given.
    """
    C = checked_coefficient(coefficient_R)
    bends = [np.cos(0.5 * gamma) for gamma in _checked_angles(angles_rad)]
    return equivalent_attenuation(*(np.exp(-log_loss(C, bend)) for bend in bends))


def log_loss(coefficient_R: Numbers, half_angle_cosine: Numbers) -> Numbers:
    """`u = -ln B` of one contact, for values known to be good.

    Args:
        coefficient_R: Friction coefficient C_R, from 0 to below 1.
        half_angle_cosine: `cos(gamma/2)`.
    """
    return 2.0 * np.arcsinh(_tangent(coefficient_R) * half_angle_cosine)


def attenuated_tension_N(tension_2_N: ArrayLike, attenuation_ratio: ArrayLike) -> Numbers:
    """Tension outside of a cable that slides in.

    Implements (23).

    `|T_1| = B |T_2|`.

    Args:
        tension_2_N: Tension inside |T_2|, N; any shape.
        attenuation_ratio: Attenuation ratio B, above 0, at most 1; broadcasts.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    T_2 = checked_array("tension_2", tension_2_N, "N", least=0.0)
    return scalar_or_array(np.asarray(checked_attenuation(attenuation_ratio) * T_2))


def equivalent_attenuation(*attenuations: ArrayLike) -> Numbers:
    """Attenuation ratio of several contacts along one cable.

    Implements (26).

    `B_eq = B_1 B_2 ... B_N`. It holds whatever the coefficients are; that they are the same, as
    the text has it, is needed to find C_R from B_eq.

    Args:
        *attenuations: Attenuation ratio of each contact, above 0, at most 1; they broadcast.

    Raises:
        InvalidInput: a value is not finite or out of its range, or none is given.
    """
    if not attenuations:
        raise InvalidInput("no attenuation ratio was given; give one for each contact")
    product = np.ones(())
    for ratio in attenuations:
        product = product * checked_attenuation(ratio)
    return scalar_or_array(np.asarray(product))


def friction_coefficient(attenuation_ratio: ArrayLike, *angles_rad: ArrayLike) -> Numbers:
    """Friction coefficient C_R from the attenuation ratio of a reel, by Newton's method.

    With the tangent `t = C_R / sqrt(1 - C_R^2)`, the sum of `2 asinh(t cos(gamma_k/2))` over the
    contacts has to be `-ln B`. The sum is concave in t, so that Newton's method climbs to the root
    from below without overshooting, between what contacts that are all of the mean bend would
    need, and what the sharpest would need alone. For one contact both are the root.

    Args:
        attenuation_ratio: Attenuation ratio B, above 0, at most 1; any shape.
        *angles_rad: Angle gamma of each contact, 0 (folded back) to pi (straight); broadcast.

    Raises:
        InvalidInput: a value is not finite or out of its range, no angle is given, or the cable
            is straight at every contact, where friction leaves no trace.
    """
    B, *angles = np.broadcast_arrays(
        checked_attenuation(attenuation_ratio), *_checked_angles(angles_rad)
    )
    straight = np.pi - np.min(angles, axis=0) < LEAST_BEND_rad
    if straight.any():
        raise InvalidInput(
            f"angle gamma is pi{index_text(first_index(straight))} at every contact: a straight cable does not "
            "tell its friction coefficient, bend it by moving one reel sideways"
        )
    shape = B.shape
    wanted = np.abs(np.log(B)).ravel()
    bends = [np.cos(0.5 * gamma).ravel() for gamma in angles]
    slack = 1e-9  # keeps the root between the bounds when they differ by rounding alone
    least = np.sinh(0.5 * wanted / len(bends)) / np.mean(bends, axis=0)
    most = np.sinh(0.5 * wanted) / np.max(bends, axis=0)
    t = newton(_missing_loss, least * (1.0 - slack), most * (1.0 + slack), wanted, *bends)
    return scalar_or_array(np.asarray(t / np.hypot(1.0, t)).reshape(shape))


def _missing_loss(
    t: FloatArray, wanted: FloatArray, *bends: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What a tangent of the friction angle leaves missing of the logarithmic loss, and slope."""
    loss, slope = np.zeros_like(t), np.zeros_like(t)
    for bend in bends:
        loss += 2.0 * np.arcsinh(t * bend)
        slope += 2.0 * bend / np.hypot(1.0, t * bend)
    return wanted - loss, -slope


def checked_coefficient(coefficient_R: ArrayLike) -> FloatArray:
    """Friction coefficients, from 0 to below 1.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    C = checked_array("friction coefficient", coefficient_R, "", least=0.0)
    if (C >= 1.0).any():
        place = first_index(C >= 1.0)
        raise InvalidInput(
            f"friction coefficient is {C[place]:g}{index_text(place)}; from 1 on the cable jams at the "
            "contact, give one below 1"
        )
    return C


def checked_attenuation(ratio: ArrayLike) -> FloatArray:
    """Attenuation ratios, above 0 and at most 1.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    B = checked_array("attenuation ratio", ratio, "", above=0.0)
    if (B > 1.0).any():
        place = first_index(B > 1.0)
        raise InvalidInput(
            f"attenuation ratio is {B[place]:.6g}{index_text(place)}; it is at most 1, as friction only "
            "takes tension away: check the gauges' zeros, or which reel was driven"
        )
    return B


def _checked_angles(angles_rad: tuple[ArrayLike, ...]) -> list[FloatArray]:
    if not angles_rad:
        raise InvalidInput("no angle was given; give gamma, in radians, of each contact")
    return [checked_angle(angle) for angle in angles_rad]


def _tangent(coefficient_R: Numbers) -> Numbers:
    """`t = C_R / sqrt(1 - C_R^2)`, tangent of the friction angle, whose sine is C_R."""
    return coefficient_R / np.sqrt((1.0 - coefficient_R) * (1.0 + coefficient_R))
