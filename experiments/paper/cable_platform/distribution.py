"""Tension distribution: tensions of the cables that balance a wrench on the platform."""

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


def distribute(
    jacobian: FloatArray, wrench: FloatArray, low_N: float, high_N: float
) -> FloatArray | None:
    """Tensions within their limits that exert a wrench, nearest to the middle of the limits.

    With one cable more than coordinates, the tensions of a wrench w = -J' t are a line
    t = t_w + lambda n along the null vector n of J': lambda is that of the middle of the limits,
    clipped to the interval in which all tensions lie within them. Continuous in J and w.

    Args:
        jacobian: Derivatives of the lengths by the coordinates, shape (cables, cables - 1).
        wrench: Force by the cables on each coordinate, shape (cables - 1,).
        low_N: Least tension tau_min, N.
        high_N: Greatest tension, N.

    Returns:
        The tensions, N, shape (cables,); None where no tensions within the limits balance it.

    Raises:
        InvalidInput: the number of cables is not one more than that of coordinates.
    """
    cables, coordinates = jacobian.shape
    if cables != coordinates + 1:
        raise InvalidInput(
            f"{cables} cables for {coordinates} coordinates: this distribution is for one more "
            "cable than coordinates"
        )
    particular = np.linalg.lstsq(-jacobian.T, wrench)[0]
    null = np.linalg.svd(jacobian.T)[2][-1]
    with np.errstate(divide="ignore"):
        ends = np.sort(np.array([low_N - particular, high_N - particular]) / null, axis=0)
    least, greatest = float(ends[0].max()), float(ends[1].min())
    if not least <= greatest:
        return None
    middle = float(null @ (0.5 * (low_N + high_N) - particular))
    return np.asarray(particular + min(max(middle, least), greatest) * null)
