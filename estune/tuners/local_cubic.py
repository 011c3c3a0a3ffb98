"""What the cost looks like about a centre, late in a search: a cubic, by regularised regression.

With z = x - c the logarithms of the parameters from the centre on, and l that of the cost,

    l(z) = l_0 + g.z + z'Hz/2 + sum c_ijk u_i u_j u_k + d a + error

is fitted to all trials by Bayesian least squares (Bishop, Pattern Recognition and Machine
Learning, 2006, section 3.3), each coefficient with a normal prior. The cubic terms are there so
that what is not symmetric about the centre does not pass for a slope; they are taken along the
axes of H, u_i = h_i^(1/3) z_i, so that a direction that hardly bends is not thought to bend back.
The last term is for a rig that drifts, with a the age of a trial. What a cubic cannot follow makes
trials far away tell less: a trial's error has the variance

    v = sigma^2 + (p q^2)^2,    q = z'Hz/2

with q by how much the cost is expected to rise, and H from the fit before; or by how much it did
rise, less some, for beyond the edge of stability it rises as no polynomial does. A trial off by
more than three of its standard deviations counts as if it were off by three (Huber): one bad trial
does not move the fit.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray

BEND = 0.5  # p, error per square of the rise
SEEN = 0.7  # share of the rise observed that counts as a rise expected
LEVEL = 3.0  # prior standard deviation of l_0
SLOPE = 1.0  # of g
CURVATURE = 1.0  # of h_ii, relative to its mean
TWIST = 0.4  # of h_ij, relative to the root of both means
CUBIC = 0.4  # of c_ijk
DRIFT = 0.05  # of d, per hundred trials
NOISE_EXPECTED = 0.03  # sigma before there are residuals to tell it
NOISE_WEIGHT = 3.0  # trials that this expectation counts for
FLAT = 0.02  # least curvature a step is taken by, or it could be of any length
FAR = 3.0  # standard deviations from which on a residual counts no more

IndexArray = NDArray[np.intp]


class LocalCubicModel(NamedTuple):
    """The posterior, given some trials.

    Attributes:
        centre: c, shape (n,).
        bend: What takes z to u, shape (n, n).
        coefficients: Of 1, z_i, z_i z_j, u_i u_j u_k and a; one column a quantity.
        spread: Their covariance, the same for every quantity.
        noise: Standard deviation sigma of one trial.
    """

    centre: FloatArray
    bend: FloatArray
    coefficients: FloatArray
    spread: FloatArray
    noise: float

    @property
    def level(self) -> float:
        """The logarithm l_0 of the cost at the centre."""
        return float(self.coefficients[0, 0])

    @property
    def slope(self) -> FloatArray:
        """The slope g of the logarithm of the cost, shape (n,)."""
        return self.coefficients[1 : 1 + len(self.centre), 0]

    @property
    def curvature(self) -> FloatArray:
        """The curvature H of it, shape (n, n)."""
        n = len(self.centre)
        return curvature_of(self.coefficients[1 + n : 1 + n + n * (n + 1) // 2, 0], n)

    def expected(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means, shape (points, quantities), and their standard deviation, shape (points,)."""
        terms = _terms(points - self.centre, self.bend, np.zeros(len(points)))
        variance = np.sum((terms @ self.spread) * terms, axis=1)
        return terms @ self.coefficients, np.sqrt(np.maximum(variance, 0.0))


def curvature_of(squares: FloatArray, n: int) -> FloatArray:
    """The curvature H by its coefficients of z_i z_j, shape (..., n, n) of (..., n (n+1)/2)."""
    upper = np.zeros((*squares.shape[:-1], n, n))
    a, b = _pairs(n)
    upper[..., a, b] = squares
    return upper + np.swapaxes(upper, -1, -2)


def fit_local_cubic(
    centre: FloatArray,
    curvature: FloatArray,
    points: FloatArray,
    values: FloatArray,
    *,
    noise: float,
    known: FloatArray,
) -> LocalCubicModel:
    """The posterior about a centre.

    Args:
        centre: c, shape (n,).
        curvature: H by which far trials are told, shape (n, n).
        points: Where the trials were, the oldest first, shape (trials, n).
        values: What was observed, the logarithm of the cost first, shape (trials, quantities).
        noise: sigma by which trials are weighted; that of the residuals comes back.
        known: Prior mean of H, shape (n, n).
    """
    z = points - centre
    rise = 0.5 * np.sum((z @ curvature) * z, axis=1)
    lowest = np.sort(values[:, 0])[: z.shape[1] + 1].mean()
    rise = np.maximum(rise, SEEN * (values[:, 0] - lowest))
    weights = 1.0 / (noise**2 + (BEND * rise**2) ** 2)
    stiff, axes = np.linalg.eigh(curvature)
    bend = axes * np.cbrt(np.maximum(stiff, FLAT))
    age = np.arange(len(z) - 1.0, -1.0, -1.0) / 100.0
    terms, (means, precisions) = _terms(z, bend, age), _prior(known)
    pulled = np.zeros((terms.shape[1], values.shape[1]))
    pulled[:, 0] = means * precisions

    def solved(weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        weighted = terms.T * weights
        known = weighted @ terms
        spread = np.asarray(np.linalg.inv(known + np.diag(precisions)), dtype=np.float64)
        return spread @ (weighted @ values + pulled), spread, known

    coefficients, spread, known = solved(weights)
    off = np.abs(values[:, 0] - terms @ coefficients[:, 0]) * np.sqrt(weights)
    if off.max() > FAR:
        weights *= FAR / np.maximum(off, FAR)
        coefficients, spread, known = solved(weights)
    left = values[:, 0] - terms @ coefficients[:, 0]
    near = weights * noise**2  # one for a trial nearby, towards zero for one far away
    free = max(float(near.sum() - np.sum(spread * known)), 1.0)
    variance = NOISE_WEIGHT * NOISE_EXPECTED**2 + float(np.sum(near * left**2))
    sigma = math.sqrt(variance / (NOISE_WEIGHT + free))
    return LocalCubicModel(centre, bend, coefficients, spread, sigma)


@lru_cache(maxsize=16)
def _pairs(n: int) -> tuple[IndexArray, IndexArray]:
    return np.triu_indices(n)


@lru_cache(maxsize=16)
def _triples(n: int) -> tuple[IndexArray, IndexArray, IndexArray]:
    triples = [(i, j, k) for i in range(n) for j in range(i, n) for k in range(j, n)]
    i, j, k = np.array(triples, dtype=np.intp).T
    return i, j, k


def _terms(z: FloatArray, bend: FloatArray, age: FloatArray) -> FloatArray:
    """1, z_i, z_i z_j and u_i u_j u_k with i <= j <= k, and the age, one row a point."""
    n, u = z.shape[1], z @ bend
    (a, b), (i, j, k) = _pairs(n), _triples(n)
    terms = np.empty((len(z), 2 + n + len(a) + len(i)))
    terms[:, 0] = 1.0
    terms[:, 1 : 1 + n] = z
    terms[:, 1 + n : 1 + n + len(a)] = z[:, a] * z[:, b]
    terms[:, 1 + n + len(a) : -1] = u[:, i] * u[:, j] * u[:, k]
    terms[:, -1] = age
    return terms


def _prior(curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and precision of every coefficient, by the prior mean of H."""
    n = len(curvature)
    (a, b), cubes = _pairs(n), len(_triples(n)[0])
    share = np.where(a == b, 0.5, 1.0)  # the coefficient of z_i^2 is half of h_ii
    size = np.sqrt(curvature[a, a] * curvature[b, b])
    squares = share * np.where(a == b, CURVATURE, TWIST) * size
    means = np.concatenate((np.zeros(1 + n), share * curvature[a, b], np.zeros(cubes + 1)))
    spreads = np.concatenate(([LEVEL], [SLOPE] * n, squares, [CUBIC] * cubes, [DRIFT]))
    return means, spreads**-2.0
