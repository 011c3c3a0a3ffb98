"""Where a cable goes at an eyelet: its direction outside and inside, and the angle between.

The axes at the eyelet are a reference vector r in its plane of symmetry, the vector across it, and
the normal N pointing outward. Directions are those of the two forces that pull the piece of cable
at the eyelet, so that a straight cable has an angle of pi between them and one that is folded back
has an angle of zero.

In the text theta_1 is the angle between T_1 and -N, so that its T_1 points inward and its T_2
outward: both are opposite to the pulls on the piece of cable. The angle between them is the same.
The functions follow (11) and (12) as printed.
"""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, Numbers, index_text, checked_array, first_index, scalar_or_array
from estune.errors import InvalidInput

_STRAIGHT_rad = 1e-7
"""Vectors nearer to one line than this span no plane that rounding leaves meaningful."""


def direction_outside(theta_1_rad: ArrayLike, phi_1_rad: ArrayLike) -> FloatArray:
    """Unit vector of the cable outside the eyelet.

    Implements (11).

    `P_1 = [cos phi_1 sin theta_1, sin phi_1 sin theta_1, -cos theta_1]`

    Args:
        theta_1_rad: Angle to the axis -N, from 0 to below pi/2; any shape.
        phi_1_rad: Angle of the projection on the plane of the eyelet, from r; broadcasts.

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

    Args:
        theta_2_rad: Angle to the axis +N, from 0 to below pi/2; any shape.
        phi_2_rad: Angle of the projection on the plane of the eyelet, from r; broadcasts.

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
    behind = theta >= 0.5 * np.pi
    if behind.any():
        place = first_index(behind)
        raise InvalidInput(
            f"{theta_name} is {theta[place]:g} rad{index_text(place)}; a cable through the eyelet has "
            "less than pi/2 on either side, turn the eyelet towards it"
        )
    theta, phi = np.broadcast_arrays(theta, phi)
    parts = [np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), axial * np.cos(theta)]
    return np.stack(parts, axis=-1)


def angle_between_rad(P_1: ArrayLike, P_2: ArrayLike) -> Numbers:
    """Angle gamma between the cable outside and inside, rad; pi where it passes straight.

    Implements (13).

    `cos gamma = P_1' P_2`, taken as `2 atan(|P_1 - P_2| / |P_1 + P_2|)`: near a straight cable,
    where most eyelets work and the friction depends on `pi - gamma`, the arc cosine would lose
    half the digits.

    Args:
        P_1: Vectors along the cable outside, shape (..., 3); their lengths do not matter.
        P_2: Vectors along the cable inside, shape (..., 3); broadcasts.

    Raises:
        InvalidInput: a value is not finite, a vector has no length or not three components.
    """
    P_1, P_2 = unit_vector("P_1", P_1), unit_vector("P_2", P_2)
    apart, along = np.linalg.norm(P_1 - P_2, axis=-1), np.linalg.norm(P_1 + P_2, axis=-1)
    return scalar_or_array(np.asarray(2.0 * np.arctan2(apart, along)))


def eyelet_angle_rad(
    theta_1_rad: ArrayLike, phi_1_rad: ArrayLike, theta_2_rad: ArrayLike, phi_2_rad: ArrayLike
) -> Numbers:
    """Angle gamma from the four angles of the cable at the eyelet: (11) to (13); they broadcast.

    Raises:
        InvalidInput: as `direction_outside` and `direction_inside`.
    """
    return angle_between_rad(
        direction_outside(theta_1_rad, phi_1_rad), direction_inside(theta_2_rad, phi_2_rad)
    )


def contact_line(P_1: ArrayLike, P_2: ArrayLike) -> FloatArray:
    """The line that stands for the eyelet as a line constraint: unit vector of `P_1 x P_2`.

    Args:
        P_1: Vectors along the cable outside, shape (..., 3).
        P_2: Vectors along the cable inside, shape (..., 3); broadcasts.

    Raises:
        InvalidInput: as `angle_between_rad`, or the two are collinear and span no plane.
    """
    across = np.cross(unit_vector("P_1", P_1), unit_vector("P_2", P_2))
    size = np.linalg.norm(across, axis=-1)
    collinear = size < _STRAIGHT_rad
    if collinear.any():
        raise InvalidInput(
            f"the cable outside and inside are collinear{index_text(first_index(collinear))}; without a bend "
            "there is neither a contact line nor friction, move one end sideways"
        )
    return np.asarray(across / size[..., None])


def unit_vector(name: str, vector: ArrayLike) -> FloatArray:
    """The vectors made one long, shape (..., 3).

    Raises:
        InvalidInput: a value is not finite, a vector has no length or not three components.
    """
    v = checked_array(name, vector, "")
    if v.ndim == 0 or v.shape[-1] != 3:
        raise InvalidInput(f"{name} has shape {v.shape}; its last axis must hold 3 components")
    size = np.linalg.norm(v, axis=-1)
    if (size == 0.0).any():
        raise InvalidInput(f"{name} has no length{index_text(first_index(size == 0.0))}; give a direction")
    return np.asarray(v / size[..., None])
