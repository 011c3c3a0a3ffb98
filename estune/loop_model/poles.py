"""Poles of a discrete model as second-order sections, and the coordinates they are searched by.

A pair of poles has the logarithms of its natural frequency w (rad/sample) and damping ratio as
coordinates, a single real pole, the last one of an odd number, the logarithm of its decay per
sample. With d = 1 - q^-1 a pole p is the factor 1 - p q^-1 = (1 - p) + p d, which keeps its digits
however slow the pole is.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray

ComplexArray = NDArray[np.complex128]

LEAST, GREATEST = -25.0, 6.0
"""Range of the logarithm of a frequency that changes the poles; beyond it they stay. That of a
damping ratio reaches to the negative of the least: an integrator beside a fast pole has such."""

FASTEST = 1e-20
"""Least magnitude of a pole of z that has coordinates."""


class PoleSection(NamedTuple):
    """One pole, or a pair of them.

    Attributes:
        taps: 1, a1 and, of a pair, a2: a polynomial in q^-1.
        powers: The same polynomial in powers of d = 1 - q^-1.
        poles: The poles.
        log_poles: Their logarithms.
    """

    taps: FloatArray
    powers: FloatArray
    poles: ComplexArray
    log_poles: ComplexArray


def sections_of(coordinates: Sequence[float] | FloatArray) -> tuple[PoleSection, ...]:
    """The sections of poles with these coordinates."""
    return _sections(tuple(float(x) for x in coordinates))


@lru_cache(maxsize=256)
def _sections(coordinates: tuple[float, ...]) -> tuple[PoleSection, ...]:
    pairs = zip(coordinates[:-1:2], coordinates[1::2], strict=True)
    if len(coordinates) % 2:
        return (*map(_pair, pairs), _single(coordinates[-1]))
    return tuple(map(_pair, zip(coordinates[::2], coordinates[1::2], strict=True)))


def _pair(at: tuple[float, float]) -> PoleSection:
    w = math.exp(min(max(at[0], LEAST), GREATEST))
    z = math.exp(min(max(at[1], LEAST), -LEAST))
    if z < 1.0:
        turn = w * math.sqrt(1.0 - z * z)
        return _of_logarithms(complex(-z * w, turn), complex(-z * w, -turn))
    spread = w * math.sqrt(z * z - 1.0)
    return _of_logarithms(complex(-w * w / (z * w + spread)), complex(-(z * w + spread)))


def _single(x: float) -> PoleSection:
    log_pole = np.array([-math.exp(min(max(x, LEAST), GREATEST))], complex)
    p, rest = float(np.exp(log_pole[0].real)), -math.expm1(log_pole[0].real)
    return PoleSection(np.array([1.0, -p]), np.array([rest, p]), np.exp(log_pole), log_pole)


def _of_logarithms(one: complex, other: complex) -> PoleSection:
    log_poles = np.array([one, other])
    p, q = np.exp(log_poles)
    u, v = -np.expm1(log_poles)  # 1 - p and 1 - q, with all their digits
    product = (p * q).real
    taps = np.array([1.0, -(p + q).real, product])
    powers = np.array([(u * v).real, (p * v + q * u).real, product])
    return PoleSection(taps, powers, np.array([p, q]), log_poles)


def pair_coordinates(a1: float, a2: float) -> FloatArray:
    """Coordinates of the pair of poles of 1 + a1 q^-1 + a2 q^-2.

    A pole at zero is taken as one that decays within a sample; poles outside the unit circle
    have none, and are taken as the ones mirrored at it.
    """
    roots = np.roots([1.0, a1, a2]).astype(complex)
    log_poles = np.log(np.where(np.abs(roots) < FASTEST, FASTEST, roots))
    product, total = abs((log_poles[0] * log_poles[1]).real), abs((log_poles.sum()).real)
    w = math.sqrt(max(product, 1e-20))
    return np.log([w, max(total / (2.0 * w), 1e-6)])


def polynomial(coordinates: Sequence[float] | FloatArray) -> FloatArray:
    """The product of all sections as a polynomial in q^-1."""
    product = np.ones(1)
    for section in sections_of(coordinates):
        product = np.convolve(product, section.taps)
    return product


def difference_polynomial(coordinates: Sequence[float] | FloatArray) -> FloatArray:
    """The same product in powers of 1 - q^-1, the constant first."""
    product = np.ones(1)
    for section in sections_of(coordinates):
        product = np.convolve(product, section.powers)
    return product


def coordinates_of(polynomials: FloatArray) -> list[tuple[float, ...] | None]:
    """Coordinates of the poles of polynomials in powers of 1 - q^-1, the constants first.

    None where a pole has none: outside the unit circle, or real and not above zero.

    Args:
        polynomials: Shape (polynomials, poles + 1).
    """
    count, poles = polynomials.shape[0], polynomials.shape[1] - 1
    # The last coefficient is the product of the poles: where nothing can be divided by it, a pole
    # is zero, or decays so far within a sample that the product underflows.
    magnitudes = np.abs(polynomials)
    nonzero = magnitudes[:, -1] > np.finfo(float).tiny * magnitudes.max(axis=1)
    companion = np.zeros((int(nonzero.sum()), poles, poles))
    companion[:, 1:, :-1] = np.eye(poles - 1)
    companion[:, :, -1] = -polynomials[nonzero, :-1] / polynomials[nonzero, -1:]
    d = np.linalg.eigvals(companion).astype(complex)
    with np.errstate(divide="ignore"):
        log_poles = -np.log1p(-d)
    found: list[tuple[float, ...] | None] = [None] * count
    for index, *row in zip(np.flatnonzero(nonzero), d.tolist(), log_poles.tolist(), strict=True):
        found[index] = _coordinates(*row)
    return found


def _coordinates(d: list[complex], log_poles: list[complex]) -> tuple[float, ...] | None:
    """Coordinates of poles by their 1 - p and the logarithms of p."""
    if not all(s.real < 0.0 for s in log_poles):
        return None
    single = [s for s, at in zip(log_poles, d, strict=True) if at.imag == 0.0]
    if any(s.imag != 0.0 for s in single):
        return None
    real = sorted(-s.real for s in single)
    swinging = [s for s, at in zip(log_poles, d, strict=True) if at.imag > 0.0]
    pairs = [(abs(s), -s.real / abs(s)) for s in swinging]
    pairs += [
        (math.sqrt(p * q), (p + q) / (2.0 * math.sqrt(p * q)))
        for p, q in zip(real[:-1:2], real[1::2], strict=False)
    ]
    logs = [math.log(value) for pair in pairs for value in pair]
    return (*logs, *(math.log(p) for p in real[len(real) - len(real) % 2 :]))
