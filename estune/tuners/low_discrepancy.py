"""Low-discrepancy points, computed and not drawn at random."""

from functools import lru_cache
from statistics import NormalDist

import numpy as np

from estune.core.quantities import FloatArray


@lru_cache(maxsize=16)
def simplex(dimensions: int) -> FloatArray:
    """The corners of a regular simplex about the origin, one unit vector a row, shape (n+1, n)."""
    centred = np.eye(dimensions + 1) - 1.0 / (dimensions + 1)
    corners = centred @ np.linalg.qr(centred[:, :dimensions])[0]
    return _read_only(corners / np.linalg.norm(corners, axis=1)[:, np.newaxis])


@lru_cache(maxsize=16)
def unit_ball_points(dimensions: int, size: int) -> FloatArray:
    """Points uniform in the unit ball, shape (size, n)."""
    cube = _unit_cube_points(dimensions + 1, size)
    directions = _normal_quantiles(cube[:, :-1])
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    return _read_only(directions * cube[:, -1:] ** (1.0 / dimensions))


@lru_cache(maxsize=16)
def normal_points(dimensions: int, size: int) -> FloatArray:
    """Points of a standard normal distribution, mean 0 and covariance 1, shape (size, n)."""
    points = _normal_quantiles(_unit_cube_points(dimensions, size))
    points -= np.mean(points, axis=0)
    root = np.linalg.cholesky(points.T @ points / size)
    return _read_only(np.asarray(np.linalg.solve(root, points.T).T, dtype=np.float64))


def _unit_cube_points(dimensions: int, size: int) -> FloatArray:
    """Kronecker sequence of the powers of the generalised golden ratio, g^(d+1) = g + 1."""
    g = 2.0
    for _ in range(64):  # halves its error at least, each time
        g = (1.0 + g) ** (1.0 / (dimensions + 1))
    powers = g ** -np.arange(1.0, dimensions + 1.0)
    points: FloatArray = (0.5 + np.outer(np.arange(1.0, size + 1.0), powers)) % 1.0
    return np.clip(points, 1e-9, 1.0 - 1e-9)


def _normal_quantiles(levels: FloatArray) -> FloatArray:
    quantile = NormalDist().inv_cdf
    return np.array([[quantile(u) for u in row] for row in levels.tolist()])


def _read_only(values: FloatArray) -> FloatArray:
    values.flags.writeable = False
    return values
