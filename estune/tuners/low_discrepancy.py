"""Points spread evenly, computed and not drawn: where to look, and what a posterior may be."""

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
    """Points that fill the unit ball evenly, shape (size, n)."""
    even = _even(dimensions + 1, size)
    directions = _normal(even[:, :-1])
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    return _read_only(directions * even[:, -1:] ** (1.0 / dimensions))


@lru_cache(maxsize=16)
def normal_points(dimensions: int, size: int) -> FloatArray:
    """What stands for draws of a standard normal distribution, shape (size, dimensions).

    Their mean is zero and their covariance one, which few even points are not by themselves.
    """
    points = _normal(_even(dimensions, size))
    points -= np.mean(points, axis=0)
    root = np.linalg.cholesky(points.T @ points / size)
    return _read_only(np.asarray(np.linalg.solve(root, points.T).T, dtype=np.float64))


def _even(dimensions: int, size: int) -> FloatArray:
    """Rows of the Kronecker sequence to the powers of the generalised golden ratio.

    The ratio is the root above one of g^(d+1) = g + 1; for d = 1 it is the golden one. No other
    known sequence without random numbers is both this short and even in any number of dimensions.
    """
    g = 2.0
    for _ in range(64):  # halves its error at least, each time
        g = (1.0 + g) ** (1.0 / (dimensions + 1))
    powers = g ** -np.arange(1.0, dimensions + 1.0)
    even: FloatArray = (0.5 + np.outer(np.arange(1.0, size + 1.0), powers)) % 1.0
    return np.clip(even, 1e-9, 1.0 - 1e-9)


def _normal(even: FloatArray) -> FloatArray:
    quantile = NormalDist().inv_cdf
    return np.array([[quantile(u) for u in row] for row in even.tolist()])


def _read_only(values: FloatArray) -> FloatArray:
    values.flags.writeable = False
    return values
