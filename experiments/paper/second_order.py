"""The underdamped second-order model of a reel, with dead time and gauge mode, sampled."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import (
    ComplexArray,
    FloatArray,
    Numbers,
    check_not_negative,
    check_positive,
    checked_array,
    scalar_or_array,
)
from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class GaugeMode:
    """The vibration of the gauge itself, of static gain one.

    Attributes:
        natural_frequency_rad_s: rad/s.
        damping: Damping ratio, between 0 and 1.

    Raises:
        InvalidInput: a value is out of its range.
    """

    natural_frequency_rad_s: float
    damping: float

    def __post_init__(self) -> None:
        _check_mode("gauge mode", self.natural_frequency_rad_s, self.damping)

    @property
    def pole_rad_s(self) -> complex:
        """The pole with positive imaginary part, rad/s."""
        return _pole(self.natural_frequency_rad_s, self.damping)


@dataclass(frozen=True, slots=True)
class SecondOrder:
    """`G(s) = gain w^2/(s^2 + 2 zeta w s + w^2) exp(-s dead time)`, and a gauge mode behind it.

    Attributes:
        gain: Output at rest per input: N/N with the effort as input, N/A with the current.
        natural_frequency_rad_s: w, undamped, rad/s.
        damping: Damping ratio zeta, between 0 and 1.
        dead_time_s: Delay of the input, s.
        gauge: The gauge's own mode in series, or None.

    Raises:
        InvalidInput: a value is out of its range.
    """

    gain: float
    natural_frequency_rad_s: float
    damping: float
    dead_time_s: float = 0.0
    gauge: GaugeMode | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gain) and self.gain != 0.0):
            raise InvalidInput(f"model gain is {self.gain}; it must be finite and not zero")
        _check_mode("model", self.natural_frequency_rad_s, self.damping)
        check_not_negative("model dead time", self.dead_time_s, "s")

    @property
    def resonance_rad_s(self) -> float:
        """The frequency at which |G| has its peak, `w sqrt(1 - 2 zeta^2)`, rad/s.

        Raises:
            InvalidInput: the damping is too high for a peak.
        """
        inside = 1.0 - 2.0 * self.damping**2
        if inside <= 0.0:
            raise InvalidInput(
                f"a damping ratio of {self.damping:.3g} leaves no resonance peak (limit 0.707); "
                "use the natural frequency"
            )
        return self.natural_frequency_rad_s * math.sqrt(inside)

    def per_effort(self, newtons_per_ampere: float) -> Self:
        """The model from effort to tension, N/N, of one from motor current to tension, N/A.

        Raises:
            InvalidInput: the tension per ampere is not above zero.
        """
        check_positive("tension per ampere", newtons_per_ampere, "N/A")
        return replace(self, gain=self.gain / newtons_per_ampere)

    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """A, B, C, E of the model without its dead time; the dead time delays the input."""
        w, zeta = self.natural_frequency_rad_s, self.damping
        first = np.array([[0.0, 1.0], [-(w**2), -2.0 * zeta * w]])
        if self.gauge is None:
            return first, np.array([0.0, self.gain * w**2]), np.array([1.0, 0.0]), 0.0
        w_g, zeta_g = self.gauge.natural_frequency_rad_s, self.gauge.damping
        A = np.zeros((4, 4))
        A[:2, :2] = first
        A[2, 3] = 1.0
        A[3] = w_g**2, 0.0, -(w_g**2), -2.0 * zeta_g * w_g
        return A, np.array([0.0, self.gain * w**2, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0]), 0.0

    def sampled_response(self, frequency_Hz: ArrayLike, sampling_Hz: float) -> ComplexArray:
        """G(exp(i 2 pi f h)) from a held input to the output sampled just before it changes.

        Args:
            frequency_Hz: Frequencies, any shape, Hz.
            sampling_Hz: Sampling rate, Hz.

        Returns:
            The exact response under zero-order hold, of the shape of the frequencies.
        """
        poles = [_pole(self.natural_frequency_rad_s, self.damping)]
        if self.gauge is not None:
            poles.append(self.gauge.pole_rad_s)
        theta = 2.0 * np.pi * np.asarray(frequency_Hz, dtype=np.float64) / sampling_Hz
        return held_response(
            theta,
            np.array(poles, np.complex128) / sampling_Hz,
            self.gain,
            self.dead_time_s * sampling_Hz,
        )


def held_response(
    theta: FloatArray, poles: ComplexArray, gain: float, delay: float
) -> ComplexArray:
    """The sampled response of resonant modes in series behind a hold and a delay.

    The partial fractions of the modes are each propagated over one sample, in which the input
    changes once, when the delay's fraction of a sample has passed (Astrom & Wittenmark, Computer-
    Controlled Systems, section on sampling a system with time delay). Continuous and once
    differentiable in the delay, so that a fit may pass a whole sample.

    Args:
        theta: Angle 2 pi f h per sample, any shape, rad.
        poles: One complex pole times h for each mode, shape (modes,); its conjugate is understood.
        gain: Gain at rest.
        delay: Dead time in samples, zero or above.

    Returns:
        Shape of theta.
    """
    a = np.concatenate([poles, poles.conj()])
    # Residue over pole; as the poles' product is the modes' gain, it has no large factors.
    apart = a[:, None] - a[None, :]
    np.fill_diagonal(apart, 1.0)
    share = gain * np.prod(np.abs(poles) ** 2) / apart.prod(axis=1) / a
    whole = math.floor(delay)
    after = np.expm1(a * (1.0 - (delay - whole)))
    before = np.expm1(a) - after
    later = np.exp(-1j * np.asarray(theta))[..., None]
    terms = share * (after + before * later) * later / (1.0 - np.exp(a) * later)
    return np.asarray(terms.sum(axis=-1) * later[..., 0] ** whole)


def hooke_constant(
    resonance_rad_s: ArrayLike, inertia_kg_m2: ArrayLike, viscous_friction_Nms: ArrayLike
) -> Numbers:
    """The reel's effective Hooke constant from the resonance of its frequency response.

    Implements (30). `k_m = b_m^2/(2 J_m) + J_m w_R^2`

    The stiffness of the torsion spring on which J_m resonates at w_R: the response of
    `J s^2 + b s + k` has its peak at `w_R^2 = k/J - b^2/(2 J^2)`.

    Args:
        resonance_rad_s: Frequency w_R of the peak, rad/s.
        inertia_kg_m2: Rotating inertia J_m at the motor axle, kg m2.
        viscous_friction_Nms: Viscous friction b_m at the motor axle, N m s/rad.

    Returns:
        k_m in N m/rad; a float for floats, else an array.

    Raises:
        InvalidInput: a value is not finite, the inertia or the resonance not above zero, or the
            friction below zero.
    """
    w = checked_array("resonance", resonance_rad_s, "rad/s", above=0.0)
    J = checked_array("inertia", inertia_kg_m2, "kg m2", above=0.0)
    b = checked_array("viscous friction", viscous_friction_Nms, "N m s/rad", least=0.0)
    return scalar_or_array(np.asarray(b**2 / (2.0 * J) + J * w**2))


def _pole(natural_frequency_rad_s: float, damping: float) -> complex:
    return natural_frequency_rad_s * complex(-damping, math.sqrt(1.0 - damping**2))


def _check_mode(what: str, natural_frequency_rad_s: float, damping: float) -> None:
    check_positive(f"{what}: natural frequency", natural_frequency_rad_s, "rad/s")
    if not (math.isfinite(damping) and 0.0 < damping < 1.0):
        raise InvalidInput(
            f"{what}: damping ratio is {damping}; a resonance has one between 0 and 1"
        )
