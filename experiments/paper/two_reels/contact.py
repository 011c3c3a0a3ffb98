"""Forces where a cable bends over a contact: a point (the eyelet) or a line (the loading lever).

The tension T_2 pulls the cable at the contact towards the reel, T_1 away from it; their sum acts
on the contact. Friction is F_R along the cable and F_L along the line. A point is a line
constraint along `P_1 x P_2`, along which the sum has no component.

In (20) friction is proportional to the total force on the contact, not to its normal part as in
Coulomb's law: C_R is the sine of the friction angle, and Coulomb's mu its tangent, `C_R / sqrt(1 -
C_R^2)`, 2 % more at 0.2. With `T_1 = exp(-u) T_2` and a turn of `w = pi - gamma`, a contact has
`sinh(u/2) = mu sin(w/2)` here, `u/2 = mu w/2` on a drum (the capstan), and `tanh(u/2) = mu
tan(w/2)` at a sharp point whose normal is the bisector. For mu = 0.2 the losses at 30 degrees are
9.8, 9.9 and 10.2 %, at 90 degrees 25, 27 and 33 %: coefficients of different models are not
interchangeable.

Arguments broadcast: tensions outside |T_1| and inside |T_2|, N; angle gamma between them from 0
(folded back) to pi (straight); friction coefficients C_R along the cable and C_L along the line.
All functions raise InvalidInput for values that are not finite or out of their range.
"""

from typing import NamedTuple

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
from experiments.paper.two_reels.geometry import unit_vector


class ContactForce(NamedTuple):
    """Force on a contact, relative to its line."""

    normal_N: Numbers  # size across the line |T_N|
    lateral_N: Numbers  # size along the line |T_L|, which the friction |F_L| must balance
    angle_rad: Numbers  # angle Psi between the force and the plane across the line


def split_contact_force(force_N: ArrayLike, line: ArrayLike) -> ContactForce:
    """Components of the force on a contact along and across its line.

    Implements (14).

    `|T_L| = |T_perp| sin(Psi) = |F_L|`, and `|T_N| = |T_perp| cos(Psi)` as in (16).

    Raises:
        InvalidInput: a value is not finite, a line has no length, or not three components.
    """
    along = unit_vector("line", line)
    force = checked_array("force", force_N, "N")
    if force.ndim == 0 or force.shape[-1] != 3:
        raise InvalidInput(f"force has shape {force.shape}; its last axis must hold 3 components")
    lateral = np.abs(np.sum(force * along, axis=-1))
    normal = np.linalg.norm(np.cross(force, along), axis=-1)
    return ContactForce(
        scalar_or_array(np.asarray(normal)),
        scalar_or_array(np.asarray(lateral)),
        scalar_or_array(np.asarray(np.arctan2(lateral, normal))),
    )


def tension_outside_N(tension_2_N: ArrayLike, friction_N: ArrayLike) -> Numbers:
    """Tension outside |T_1| when the reel winds in, or is about to.

    Implements (15).

    `|T_1| = |T_2| - |F_R|`. When the cable is paid out the two tensions change places.

    Raises:
        InvalidInput: a value is not finite or negative, or the friction exceeds the tension.
    """
    T_2 = checked_array("tension_2", tension_2_N, "N", least=0.0)
    F_R = checked_array("friction", friction_N, "N", least=0.0)
    T_1 = np.asarray(T_2 - F_R)
    if (T_1 < 0.0).any():
        place = first_index(T_1 < 0.0)
        raise InvalidInput(
            f"friction exceeds the tension inside by {-T_1[place]:g} N{index_text(place)}; the "
            "cable would be slack outside, check the friction coefficient"
        )
    return scalar_or_array(T_1)


def sticks(
    contact: ContactForce,
    friction_N: ArrayLike,
    coefficient_R: ArrayLike,
    coefficient_L: ArrayLike,
) -> Numbers:
    """Whether friction holds the cable on the contact without sliding.

    Implements (16).

    `|T_N| >= sqrt((|F_R|/C_R)^2 + (|F_L|/C_L)^2)` with `|F_L| = |T_L|`: the friction lies within
    an ellipse whose axes the two coefficients make.

    Returns:
        True or False, or an array of them.
    """
    F_R = checked_array("friction", friction_N, "N", least=0.0)
    C_R = checked_array("coefficient_R", coefficient_R, "", above=0.0)
    C_L = checked_array("coefficient_L", coefficient_L, "", above=0.0)
    holds = np.asarray(contact.normal_N >= np.hypot(F_R / C_R, contact.lateral_N / C_L))
    return holds.item() if holds.ndim == 0 else holds


def plane_tensions_N(
    tension_1_N: ArrayLike, tension_2_N: ArrayLike, angle_rad: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """The two tensions as vectors in the plane of the bend.

    Implements (17).

    `T_2 = |T_2| [1, 0]` and `T_1 = |T_1| [cos gamma, sin gamma]`.

    Returns:
        T_1 and T_2, N, each of shape (..., 2).
    """
    T_1, T_2, gamma = np.broadcast_arrays(*_tensions(tension_1_N, tension_2_N, angle_rad))
    outside = T_1[..., None] * np.stack([np.cos(gamma), np.sin(gamma)], axis=-1)
    inside = np.stack([T_2, np.zeros_like(T_2)], axis=-1)
    return outside, inside


def contact_force_N(
    tension_1_N: ArrayLike, tension_2_N: ArrayLike, angle_rad: ArrayLike
) -> Numbers:
    """Magnitude of the force on the contact |T_perp|.

    Implements (18) and (19).

    `|T_1 + T_2| = sqrt(|T_1|^2 + |T_2|^2 + 2 |T_1||T_2| cos gamma)`, taken as
    `hypot((T_1 + T_2) cos(gamma/2), (T_1 - T_2) sin(gamma/2))`, which does not cancel for a cable
    that is almost straight.
    """
    T_1, T_2, gamma = _tensions(tension_1_N, tension_2_N, angle_rad)
    half = 0.5 * gamma
    force = np.hypot((T_1 + T_2) * np.cos(half), (T_1 - T_2) * np.sin(half))
    return scalar_or_array(np.asarray(force))


def friction_N(
    contact_N: ArrayLike,
    coefficient_R: ArrayLike,
    lateral_angle_rad: ArrayLike = 0.0,
    coefficient_L: ArrayLike = np.inf,
) -> Numbers:
    """Maximum friction along the cable |F_R| before sliding.

    Implements (20).

    `|F_R| = C_R |T_perp|` where nothing pushes the cable along the line. With a lateral angle,
    (16) with its equality: `C_R |T_perp| sqrt(cos^2(Psi) - (sin(Psi)/C_L)^2)`.

    Raises:
        InvalidInput: a value is not finite or out of its range, or the angle lies outside the
            friction cone, where the cable slides along the line for any F_R.
    """
    T = checked_array("contact force", contact_N, "N", least=0.0)
    C_R = checked_array("coefficient_R", coefficient_R, "", least=0.0)
    Psi = np.abs(checked_array("lateral angle", lateral_angle_rad, "rad"))
    if not Psi.any():
        return scalar_or_array(np.asarray(C_R * T))
    C_L = checked_array("coefficient_L", coefficient_L, "", above=0.0)
    outside = np.asarray(Psi > np.arctan(C_L))
    if outside.any():
        place = first_index(outside)
        limit = np.broadcast_to(np.arctan(C_L), outside.shape)[place]
        raise InvalidInput(
            f"lateral angle is {np.broadcast_to(Psi, outside.shape)[place]:g} "
            f"rad{index_text(place)}, outside the friction cone of {limit:g} rad: the cable "
            "slides along the line; turn the lever across the cable or raise coefficient_L"
        )
    remaining = np.maximum(np.cos(Psi) ** 2 - (np.sin(Psi) / C_L) ** 2, 0.0)
    return scalar_or_array(np.asarray(C_R * T * np.sqrt(remaining)))


def checked_angle(angle_rad: ArrayLike) -> FloatArray:
    """Angles gamma between the two tensions, 0 to pi."""
    gamma = checked_array("angle gamma", angle_rad, "rad", least=0.0)
    range_ = "it lies between 0 (folded back) and pi (straight), in radians"
    refuse_where(gamma > np.pi, "angle gamma", gamma, "rad", range_)
    return gamma


def _tensions(
    tension_1_N: ArrayLike, tension_2_N: ArrayLike, angle_rad: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    return (
        checked_array("tension_1", tension_1_N, "N", least=0.0),
        checked_array("tension_2", tension_2_N, "N", least=0.0),
        checked_angle(angle_rad),
    )
