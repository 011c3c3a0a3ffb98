"""Directions of a cable outside and inside an eyelet, and the angle between them.

The axes at the eyelet are a reference vector r in its plane of symmetry, the vector across it, and
the normal N pointing outward. Directions are those of the two forces on the cable at the eyelet:
the angle between them is pi for a straight cable and zero for one folded back.

In the text theta_1 is the angle between T_1 and -N: its T_1 points inward and its T_2 outward,
both opposite to the forces on the cable. The angle between them is the same. The functions follow
(11) and (12) as printed.

Angles theta, from 0 to below pi/2, are to the axis, phi those of the projection on the plane of
the eyelet, from r, in rad; they broadcast. Vectors have shape (..., 3), and their length is
irrelevant.
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

_STRAIGHT_rad = 1e-7
"""Minimum angle of two vectors that span a plane, for rounding."""


def direction_outside(theta_1_rad: ArrayLike, phi_1_rad: ArrayLike) -> FloatArray:
    """Unit vector of the cable outside the eyelet.

    Implements (11).

    `P_1 = [cos phi_1 sin theta_1, sin phi_1 sin theta_1, -cos theta_1]`

    Returns:
        Unit vectors, shape (..., 3).

    Raises:
        InvalidInput: a value is not finite, or the cable would not pass through the eyelet.
    """
    return _direction("theta_1", theta_1_rad, "phi_1", phi_1_rad, axial=-1.0)


def direction_inside(theta_2_rad: ArrayLike, phi_2_rad: ArrayLike) -> FloatArray:
    """Unit vector of the cable inside the reel.

    Implements (12).

    `P_2 = [cos phi_2 sin theta_2, sin phi_2 sin theta_2, cos theta_2]`

    Returns:
        Unit vectors, shape (..., 3).

    Raises:
        InvalidInput: a value is not finite, or the cable would not pass through the eyelet.
    """
    return _direction("theta_2", theta_2_rad, "phi_2", phi_2_rad, axial=1.0)


def _direction(
    theta_name: str, theta_rad: ArrayLike, phi_name: str, phi_rad: ArrayLike, axial: float
) -> FloatArray:
    theta = checked_array(theta_name, theta_rad, "rad", least=0.0)
    phi = checked_array(phi_name, phi_rad, "rad")
    remedy = (
        "a cable through the eyelet has less than pi/2 on either side, turn the eyelet towards it"
    )
    refuse_where(theta >= 0.5 * np.pi, theta_name, theta, "rad", remedy)
    theta, phi = np.broadcast_arrays(theta, phi)
    parts = [np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), axial * np.cos(theta)]
    return np.stack(parts, axis=-1)


def angle_between_rad(P_1: ArrayLike, P_2: ArrayLike) -> Numbers:
    """Angle gamma between the cable outside and inside, rad; pi where it passes straight.

    Implements (13).

    `cos gamma = P_1' P_2`, computed as `2 atan(|P_1 - P_2| / |P_1 + P_2|)`: the arc cosine would
    lose half the digits near a straight cable.

    Raises:
        InvalidInput: a value is not finite, a vector has no length or not three components.
    """
    P_1, P_2 = unit_vector("P_1", P_1), unit_vector("P_2", P_2)
    apart, along = np.linalg.norm(P_1 - P_2, axis=-1), np.linalg.norm(P_1 + P_2, axis=-1)
    return scalar_or_array(np.asarray(2.0 * np.arctan2(apart, along)))


def eyelet_angle_rad(
    theta_1_rad: ArrayLike, phi_1_rad: ArrayLike, theta_2_rad: ArrayLike, phi_2_rad: ArrayLike
) -> Numbers:
    """Angle gamma from the four angles of the cable at the eyelet: (11) to (13)."""
    return angle_between_rad(
        direction_outside(theta_1_rad, phi_1_rad), direction_inside(theta_2_rad, phi_2_rad)
    )


def contact_line(P_1: ArrayLike, P_2: ArrayLike) -> FloatArray:
    """Line of contact at the eyelet: unit vector of `P_1 x P_2`."""
    across = np.cross(unit_vector("P_1", P_1), unit_vector("P_2", P_2))
    size = np.linalg.norm(across, axis=-1)
    collinear = size < _STRAIGHT_rad
    if collinear.any():
        raise InvalidInput(
            f"the cable outside and inside are collinear{index_text(first_index(collinear))}; "
            "without a bend there is neither a contact line nor friction, move one end sideways"
        )
    return np.asarray(across / size[..., None])


def unit_vector(name: str, vector: ArrayLike) -> FloatArray:
    """The vectors with unit length, shape (..., 3).

    Raises:
        InvalidInput: a value is not finite, a vector has no length or not three components.
    """
    v = checked_array(name, vector, "")
    if v.ndim == 0 or v.shape[-1] != 3:
        raise InvalidInput(f"{name} has shape {v.shape}; its last axis must hold 3 components")
    size = np.linalg.norm(v, axis=-1)
    if (size == 0.0).any():
        place = index_text(first_index(size == 0.0))
        raise InvalidInput(f"{name} has no length{place}; give a direction")
    return np.asarray(v / size[..., None])
