"""Noise of a loop: a load at the plant's input, a drift of the output and white noise.

With A of the plant and P = 1 - (1 - 1/(30 T)) q^-1, T the settling time in samples, the
measurement is y = G u + H e, e white, and

    H = C / (A P N),     g C C* = A A* P P* + k1 |A(1)|^2 + k2 A A*

where C begins with one (spectral factorisation), k1 >= 0 is of the load and k2 >= 0 of the drift,
and N is the colour of the sensor's noise, one where it is white; without load and drift H = 1.
In s = z + 1/z - 2 the factors are p p* = (1-p)^2 - p s for each pole p, which keeps the digits of
slow poles.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.poles import OUTSIDE, ComplexArray, PoleSection, sections_of

FASTEST = 1e-9
"""Least magnitude of a pole that counts: a faster one is none."""

RESPONSE = 1024
"""Samples after which a colour has died out: it stands for less than ten."""

LEAST = 1e-9
"""Size of load or drift below which there is none."""

NOISE_RANGE = 25.0
"""Largest size of the logarithm of k1 and k2, at which the one noise is all or nothing."""

SLOW = 30.0
"""Settling times in which load and drift forget."""


class NoiseModel(NamedTuple):
    """Sizes of load and drift against the sensor's noise, and its colour.

    Attributes:
        load: k1.
        drift: k2.
        colour: Coefficients of N behind its leading one.
    """

    load: float = 0.0
    drift: float = 0.0
    colour: tuple[float, ...] = ()

    @property
    def sizes(self) -> tuple[float, float]:
        """k1 and k2."""
        return self.load, self.drift

    @property
    def counted(self) -> "NoiseModel":
        """The same, where a load or a drift of no size is none."""
        load, drift = (k if k >= LEAST else 0.0 for k in self.sizes)
        return self._replace(load=load, drift=drift)

    @property
    def logarithms(self) -> tuple[float, ...]:
        """Those of the sizes above zero, which a search moves."""
        return tuple(math.log(k) for k in self.sizes if k > 0.0)

    def with_logarithms(self, logarithms: FloatArray) -> "NoiseModel":
        """The same with other sizes in place of those above zero."""
        sizes = iter(np.exp(np.clip(logarithms, -NOISE_RANGE, NOISE_RANGE)).tolist())
        load, drift = (next(sizes) if k > 0.0 else 0.0 for k in self.sizes)
        return NoiseModel(load, drift, self.colour)

    @property
    def is_white(self) -> bool:
        """Whether there is neither load nor drift."""
        return not (self.load or self.drift)


WHITE = NoiseModel()


class Shaping(NamedTuple):
    """The filter H of a noise model.

    Attributes:
        zeros: C in sections, polynomials in q^-1.
        poles: A P N in sections.
        effort: P N, which the effort is filtered by beside C.
        gain: Variance of e over that of the sensor's noise.
        mirrored: A P N in sections with the poles outside the unit circle replaced by their
            inverses: |H| times `growth`, and finite.
        growth: Product of the sizes of these poles.
    """

    zeros: tuple[FloatArray, ...]
    poles: tuple[FloatArray, ...]
    effort: FloatArray
    gain: float
    mirrored: tuple[FloatArray, ...]
    growth: float


def shaping(
    coordinates: Sequence[float] | FloatArray, noise: NoiseModel, settling_samples: float
) -> Shaping:
    """The filter of a noise that is not white, for a plant with poles of these coordinates."""
    return _shaping(tuple(float(x) for x in coordinates), noise, settling_samples)


@lru_cache(maxsize=64)
def _shaping(
    coordinates: tuple[float, ...], noise: NoiseModel, settling_samples: float
) -> Shaping:
    slow = 1.0 - 1.0 / (SLOW * settling_samples)
    sections, unit, plant, at_one, leading = _of_plant(coordinates, slow)
    spectrum = np.convolve(plant.real, [-slow * unit, (1.0 - slow) ** 2])
    spectrum[1:] += noise.drift * plant.real
    spectrum[-1] += noise.load * at_one
    roots = _inside(np.asarray(unit * np.roots(spectrum), complex))
    gain = abs(leading) / max(float(np.abs(np.prod(roots))), 1e-300)
    PN = np.convolve([1.0, -slow], [1.0, *noise.colour])
    gain /= _power_gain(noise.colour)
    return Shaping(
        _real_sections(roots),
        (*(one.taps for one in sections), PN),
        PN,
        gain,
        (*(one.mirrored for one in sections), PN),
        math.prod(one.growth for one in sections),
    )


class _Plant(NamedTuple):
    """What of a noise's filter depends on the plant alone.

    Attributes:
        unit: Share of s in units of which roots are sought.
        factors: A A* without its poles of no size, in powers of s in that unit.
        at_one: |A(1)|^2.
        leading: Product of the poles and of that of the slow forgetting.
    """

    sections: tuple[PoleSection, ...]
    unit: float
    factors: ComplexArray
    at_one: float
    leading: complex


@lru_cache(maxsize=64)
def _of_plant(coordinates: tuple[float, ...], slow: float) -> _Plant:
    sections = sections_of(coordinates)
    # Roots in units of this share of s: they are as small as the squares of the slow poles.
    first = coordinates[0] - OUTSIDE if sections[0].grows else coordinates[0]
    unit = math.exp(2.0 * min(max(first, -12.0), 1.0))
    plant, at_one, leading = np.ones(1, complex), 1.0, complex(slow)
    for section in sections:
        at_one *= float(section.powers[0]) ** 2
        for p, u in zip(section.poles, -np.expm1(section.log_poles), strict=True):
            if abs(p) > FASTEST:
                plant, leading = np.convolve(plant, np.array([-p * unit, u * u])), leading * p
    return _Plant(sections, unit, plant, at_one, leading)


@lru_cache(maxsize=64)
def _power_gain(colour: tuple[float, ...]) -> float:
    """Variance of noise of this colour over that of the white noise that it is made of."""
    response = lfilter([1.0], [1.0, *colour], np.eye(1, RESPONSE)[0])
    return float(response @ response)


def _inside(s: ComplexArray) -> ComplexArray:
    """The zeros within the unit circle of z + 1/z - 2 = s."""
    root = np.sqrt(s + s * s / 4.0)
    one, other = 1.0 + s / 2.0 - root, 1.0 + s / 2.0 + root
    return np.where(np.abs(one) <= np.abs(other), one, other)


def _real_sections(roots: ComplexArray) -> tuple[FloatArray, ...]:
    """Real polynomials in q^-1 of degree two, the last perhaps of one, with these zeros."""
    real = np.sort(roots[np.abs(roots.imag) <= 1e-12].real)
    pairs = [np.array([1.0, -2.0 * r.real, abs(r) ** 2]) for r in roots if r.imag > 1e-12]
    pairs += [
        np.array([1.0, -(p + q), p * q]) for p, q in zip(real[::2], real[1::2], strict=False)
    ]
    return (*pairs, *([np.array([1.0, -float(real[-1])])] if real.size % 2 else []))
