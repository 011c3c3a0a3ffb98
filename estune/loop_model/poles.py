"""Poles of a discrete model as second-order sections, and the coordinates they are searched by.

A pair of poles has the logarithms of its natural frequency w (rad/sample) and damping ratio as
coordinates, a single real pole, the last one of an odd number, the logarithm of its decay per
sample. With d = 1 - q^-1 a pole p is the factor 1 - p q^-1 = (1 - p) + p d, which keeps its digits
however slow the pole is.

A pole outside the unit circle has the logarithm of its growth per sample plus `OUTSIDE`, which is
far beyond all logarithms of the others. A pair is then (growth, decay) of two real poles, or, with
`OUTSIDE` added to both, the frequency and the damping ratio of the two poles whose inverses they
are. No search leads from one kind to another: with a growth or a decay of nothing a pole is an
integrator.
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

OUTSIDE = 100.0
"""What is added to the logarithm of a growth."""

GROWS_FROM, GROWS_TO = OUTSIDE / 2.0, 1.5 * OUTSIDE
"""Coordinates between which it is one of a growing pole. Beyond both it is a pole that decays
within a sample: a step along a direction that records do not know, of 1e7 say, makes none grow."""

MOST_GROWTH = 1.0
"""Largest logarithm of a growth: such a pole is 15 times as large after each sample."""

FASTEST = 1e-20
"""Least magnitude of a pole of z that has coordinates."""


class PoleSection(NamedTuple):
    """One pole, or a pair of them.

    Attributes:
        taps: 1, a1 and, of a pair, a2: a polynomial in q^-1.
        powers: The same polynomial in powers of d = 1 - q^-1.
        log_poles: Their logarithms.
        mirrored: The taps with each pole outside the unit circle replaced by its inverse.
        growth: Product of the sizes of the poles outside; one without any.
    """

    taps: FloatArray
    powers: FloatArray
    poles: ComplexArray
    log_poles: ComplexArray
    mirrored: FloatArray
    growth: float

    @property
    def grows(self) -> bool:
        """Whether a pole lies outside the unit circle."""
        return self.growth > 1.0


def sections_of(coordinates: Sequence[float] | FloatArray) -> tuple[PoleSection, ...]:
    """The sections of poles with these coordinates."""
    return _sections(tuple(float(x) for x in coordinates))


@lru_cache(maxsize=256)
def _sections(coordinates: tuple[float, ...]) -> tuple[PoleSection, ...]:
    pairs = zip(coordinates[:-1:2], coordinates[1::2], strict=True)
    if len(coordinates) % 2:
        return (*map(_pair, pairs), _single(coordinates[-1]))
    return tuple(map(_pair, zip(coordinates[::2], coordinates[1::2], strict=True)))


@lru_cache(maxsize=256)
def _pair(at: tuple[float, float]) -> PoleSection:
    grow = [GROWS_FROM < x < GROWS_TO for x in at]
    if grow[0] and not grow[1]:
        decay = math.exp(min(max(at[1], LEAST), GREATEST))
        return _of_logarithms(complex(_growth(at[0])), complex(-decay))
    if grow[0]:
        inverse = _pair((at[0] - OUTSIDE, at[1] - OUTSIDE)).log_poles
        most = math.exp(MOST_GROWTH)
        one, other = (complex(min(-s.real, most), -s.imag) for s in inverse.tolist())
        return _of_logarithms(one, other)
    w = math.exp(min(max(at[0], LEAST), GREATEST))
    z = math.exp(min(max(at[1], LEAST), -LEAST))
    if z < 1.0:
        turn = w * math.sqrt(1.0 - z * z)
        return _of_logarithms(complex(-z * w, turn), complex(-z * w, -turn))
    spread = w * math.sqrt(z * z - 1.0)
    return _of_logarithms(complex(-w * w / (z * w + spread)), complex(-(z * w + spread)))


def _growth(x: float) -> float:
    """Logarithm of a pole outside the unit circle with this coordinate."""
    return math.exp(min(max(x - OUTSIDE, LEAST), MOST_GROWTH))


@lru_cache(maxsize=256)
def _single(x: float) -> PoleSection:
    log_p = _growth(x) if GROWS_FROM < x < GROWS_TO else -math.exp(min(max(x, LEAST), GREATEST))
    p, rest = float(np.exp(log_p)), -math.expm1(log_p)
    return PoleSection(
        np.array([1.0, -p]),
        np.array([rest, p]),
        np.array([p], complex),
        np.array([log_p], complex),
        np.array([1.0, -math.exp(-abs(log_p))]),
        max(p, 1.0),
    )


def _of_logarithms(one: complex, other: complex) -> PoleSection:
    log_poles = np.array([one, other])
    p, q = np.exp(log_poles)
    u, v = -np.expm1(log_poles)  # 1 - p and 1 - q, with all their digits
    product = (p * q).real
    taps = np.array([1.0, -(p + q).real, product])
    powers = np.array([(u * v).real, (p * v + q * u).real, product])
    r, s = np.exp(np.where(log_poles.real > 0.0, -log_poles.conj(), log_poles))
    inside = max(one.real, other.real) <= 0.0
    turned = taps if inside else np.array([1.0, -(r + s).real, (r * s).real])
    growth = math.exp(max(one.real, 0.0) + max(other.real, 0.0))
    return PoleSection(taps, powers, np.array([p, q]), log_poles, turned, growth)


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


def with_single(poles: FloatArray, single: float) -> FloatArray:
    """Coordinates with one more real pole; two single ones are a pair."""
    if poles.size % 2 == 0 or poles[-1] > GROWS_FROM:
        return np.append(poles, single)
    p, q = math.exp(-math.exp(poles[-1])), math.exp(-math.exp(single))
    return np.append(poles[:-1], pair_coordinates(-(p + q), p * q))


def slowest_decay(coordinates: FloatArray) -> float:
    """Size of the logarithm of the slowest pole, or growth, per sample."""
    logs = np.concatenate([section.log_poles for section in sections_of(coordinates)])
    return max(float(np.abs(logs).min()), 1e-6)


def mirrored(coordinates: FloatArray) -> FloatArray:
    """The coordinates with each pole outside the unit circle replaced by its inverse."""
    grow = (coordinates > GROWS_FROM) & (coordinates < GROWS_TO)
    found = np.where(grow, coordinates - OUTSIDE, coordinates)
    for i in range(0, coordinates.size - 1, 2):
        if grow[i] and not grow[i + 1]:
            mean, half = found[i : i + 2].sum() / 2.0, (found[i] - found[i + 1]) / 2.0
            found[i : i + 2] = mean, np.logaddexp(half, -half) - math.log(2.0)
    return found


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


def coordinates_of(
    polynomials: FloatArray, *, growing: bool = False
) -> list[tuple[float, ...] | None]:
    """Coordinates of the poles of polynomials in powers of 1 - q^-1, the constants first.

    None where a pole has none: real and not above zero, or outside the unit circle where none
    may be.

    Args:
        polynomials: Shape (polynomials, poles + 1).
        growing: Whether poles may lie outside the unit circle.
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
        found[index] = _with_growing(*row) if growing else _coordinates(*row)
    return found


def _with_growing(d: list[complex], log_poles: list[complex]) -> tuple[float, ...] | None:
    """Coordinates of poles that may lie outside the unit circle, these first.

    A single growing pole is a pair with the slowest real one beside it, or the last coordinate
    where it is alone; two are a pair.
    """
    poles = list(zip(d, log_poles, strict=True))
    outside = [(at, -s) for at, s in poles if s.real > 0.0]
    inside = [(at, s) for at, s in poles if not s.real > 0.0]
    single = sorted((-s.real, k) for k, (at, s) in enumerate(inside) if at.imag == 0.0)
    beside, last = list[float](), list[float]()
    if len(outside) % 2:
        slowest = min(outside, key=lambda one: (one[0].imag != 0.0, -one[1].real))
        outside.remove(slowest)
        growth = math.log(max(-slowest[1].real, 1e-300)) + OUTSIDE
        if slowest[1].imag != 0.0:
            return None
        if single:
            beside = [growth, math.log(single[0][0])] if single[0][0] > 0.0 else []
            del inside[single[0][1]]
        else:
            last = [growth]
    pairs = _coordinates(*map(list, zip(*outside, strict=True))) if outside else ()
    rest = _coordinates(*map(list, zip(*inside, strict=True))) if inside else ()
    if pairs is None or rest is None:
        return None
    return (*beside, *(x + OUTSIDE for x in pairs), *rest, *last)


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
