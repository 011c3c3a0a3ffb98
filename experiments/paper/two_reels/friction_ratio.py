"""Attenuation ratio B of a contact from the friction coefficient C_R, and the inverse.

A cable that slides in over an eyelet has `|T_1| = B |T_2|` outside. With `u = -ln B`, (21) is
`sinh(u/2) = C_R / sqrt(1 - C_R^2) cos(gamma/2)`: u adds up over several contacts, and the form has
no cancellation for a nearly straight cable or little friction.

Arguments broadcast: tensions outside |T_1| and inside |T_2|, N; friction coefficient C_R from 0 to
below 1; angle gamma from 0 (folded back) to pi (straight); attenuation ratio B above 0, at most 1.
All functions raise InvalidInput for values that are not finite or out of their range.
"""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import (
    FloatArray,
    Numbers,
    checked_array,
    first_index,
    index_text,
    refuse_where,
    scalar_or_array,
)
from estune.errors import InvalidInput
from experiments.paper.cable.roots import newton
from experiments.paper.two_reels.contact import checked_angle, contact_force_N, friction_N

LEAST_BEND_rad = 1e-6
"""Minimum bend at which friction can be determined."""


def sliding_excess_N(
    tension_1_N: ArrayLike,
    tension_2_N: ArrayLike,
    coefficient_R: ArrayLike,
    angle_rad: ArrayLike,
) -> Numbers:
    """Difference of the tensions in excess of the maximum friction, N.

    Implements (21).

    `|T_2| - |T_1| - C_R sqrt(|T_1|^2 + |T_2|^2 + 2 |T_1||T_2| cos gamma)`: zero where the cable
    slides in or is about to, below zero where it sticks.
    """
    contact = contact_force_N(tension_1_N, tension_2_N, angle_rad)
    held = friction_N(contact, coefficient_R)
    return scalar_or_array(np.asarray(np.asarray(tension_2_N) - np.asarray(tension_1_N) - held))


def capital_gamma(coefficient_R: ArrayLike, angle_rad: ArrayLike) -> Numbers:
    """The coefficient Gamma of the quadratic equation (22).

    Implements (25).

    `Gamma = (1 + C_R^2 cos gamma) / (1 - C_R^2)`, 1 or more for C_R below one. From C_R = 1 on, a
    folded cable jams at the contact.
    """
    C, gamma = checked_coefficient(coefficient_R), checked_angle(angle_rad)
    # 1 + 2 sinh^2(u/2): the printed quotient, without losing Gamma - 1.
    return scalar_or_array(np.asarray(1.0 + 2.0 * (_tangent(C) * np.cos(0.5 * gamma)) ** 2))


def attenuation(coefficient_R: ArrayLike, *angles_rad: ArrayLike) -> Numbers:
    """Attenuation ratio B of a reel with one contact or several of the same coefficient.

    Implements (22) and (24).

    `|T_1|^2 + |T_2|^2 - 2 |T_1||T_2| Gamma = 0` has the roots `B = Gamma - sqrt(Gamma^2 - 1)` and
    its inverse. The text excludes the inverse by `B >= 0`, but both are positive: the inverse is
    the ratio of a cable that is paid out, excluded by (15). Several contacts have the product
    (26).

    Returns:
        B, above 0, at most 1.

    Raises:
        InvalidInput: a value is not finite or out of its range, or no angle is given.
    """
    C = checked_coefficient(coefficient_R)
    bends = [np.cos(0.5 * gamma) for gamma in _checked_angles(angles_rad)]
    return equivalent_attenuation(*(np.exp(-log_loss(C, bend)) for bend in bends))


def log_loss(coefficient_R: Numbers, half_angle_cosine: Numbers) -> Numbers:
    """`u = -ln B` of one contact, for valid values."""
    return 2.0 * np.arcsinh(_tangent(coefficient_R) * half_angle_cosine)


def attenuated_tension_N(tension_2_N: ArrayLike, attenuation_ratio: ArrayLike) -> Numbers:
    """Tension outside of a cable that slides in.

    Implements (23).

    `|T_1| = B |T_2|`.
    """
    T_2 = checked_array("tension_2", tension_2_N, "N", least=0.0)
    return scalar_or_array(np.asarray(checked_attenuation(attenuation_ratio) * T_2))


def equivalent_attenuation(*attenuations: ArrayLike) -> Numbers:
    """Attenuation ratio of several contacts along one cable.

    Implements (26).

    `B_eq = B_1 B_2 ... B_N` for any coefficients; equal ones, as in the text, are needed only to
    find C_R from B_eq.

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
    contacts equals `-ln B`. The sum is concave in t, so that Newton's method does not overshoot
    from below. The root is bracketed by those for all contacts of the mean bend, and for the
    sharpest contact alone.

    Raises:
        InvalidInput: a value is not finite or out of its range, no angle is given, or the cable
            is straight at every contact.
    """
    B, *angles = np.broadcast_arrays(
        checked_attenuation(attenuation_ratio), *_checked_angles(angles_rad)
    )
    straight = np.pi - np.min(angles, axis=0) < LEAST_BEND_rad
    if straight.any():
        raise InvalidInput(
            f"angle gamma is pi{index_text(first_index(straight))} at every contact: a straight "
            "cable does not show its friction coefficient, bend it by moving one reel sideways"
        )
    shape = B.shape
    log_loss_target = np.abs(np.log(B)).ravel()
    bends = [np.cos(0.5 * gamma).ravel() for gamma in angles]
    slack = 1e-9  # keeps the root inside bounds that differ by rounding alone
    low = np.sinh(0.5 * log_loss_target / len(bends)) / np.mean(bends, axis=0)
    high = np.sinh(0.5 * log_loss_target) / np.max(bends, axis=0)
    t = newton(_missing_loss, low * (1.0 - slack), high * (1.0 + slack), log_loss_target, *bends)
    return scalar_or_array(np.asarray(t / np.hypot(1.0, t)).reshape(shape))


def _missing_loss(
    t: FloatArray, log_loss_target: FloatArray, *bends: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual of the logarithmic loss for a tangent of the friction angle, and its slope."""
    loss, slope = np.zeros_like(t), np.zeros_like(t)
    for bend in bends:
        loss += 2.0 * np.arcsinh(t * bend)
        slope += 2.0 * bend / np.hypot(1.0, t * bend)
    return log_loss_target - loss, -slope


def checked_coefficient(coefficient_R: ArrayLike) -> FloatArray:
    """Friction coefficients, from 0 to below 1."""
    C = checked_array("friction coefficient", coefficient_R, "", least=0.0)
    remedy = "from 1 on the cable jams at the contact, give one below 1"
    refuse_where(C >= 1.0, "friction coefficient", C, "", remedy)
    return C


def checked_attenuation(ratio: ArrayLike) -> FloatArray:
    """Attenuation ratios, above 0 and at most 1."""
    B = checked_array("attenuation ratio", ratio, "", above=0.0)
    remedy = (
        "it is at most 1, as friction only takes tension away: check the gauges' zeros, or which "
        "reel was driven"
    )
    refuse_where(B > 1.0, "attenuation ratio", B, "", remedy)
    return B


def _checked_angles(angles_rad: tuple[ArrayLike, ...]) -> list[FloatArray]:
    if not angles_rad:
        raise InvalidInput("no angle was given; give gamma, in radians, of each contact")
    return [checked_angle(angle) for angle in angles_rad]


def _tangent(coefficient_R: Numbers) -> Numbers:
    """`t = C_R / sqrt(1 - C_R^2)`, tangent of the friction angle, whose sine is C_R."""
    return coefficient_R / np.sqrt((1.0 - coefficient_R) * (1.0 + coefficient_R))
