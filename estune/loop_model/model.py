"""A discrete linear model of the plant, and the closed loop it forms with the controller.

With q^-1 the backward shift and d whole samples of dead time,

    y = G u,      G = q^-(d+1) B / A,      A the product of second-order sections (`poles`),
    B = b0 + b1 (1 - q^-1) + b2 (1 - q^-1)^2 + ...,      one term more than poles
    R u = T F r - S y                                     (`estune.core.controller_equation`)

All signals are deviations from a steady state.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import (
    ControllerPolynomials,
    controller_polynomials,
    filter_terms,
)
from estune.core.controller_form import OWN_FORM
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.bend import STRAIGHT, Bend
from estune.loop_model.poles import PoleSection, polynomial, sections_of


class LoopModel(NamedTuple):
    """Poles, a numerator, a dead time, dry friction and the bend of the plant.

    Attributes:
        numerator: B in powers of 1 - q^-1, N of measurement per N of effort.
        dead_samples: Whole samples d of dead time beyond the one of sampling.
        friction: Size of the dry friction that the effort works against; zero is none. It
            acts on the first pair of poles. Margins are those of the linear part.
        bend: Of spring and sensor. Margins are those at the end of the step.
    """

    coordinates: tuple[float, ...]
    numerator: tuple[float, ...]
    dead_samples: int
    friction: float = 0.0
    bend: Bend = STRAIGHT

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.coordinates)

    @property
    def parameters(self) -> FloatArray:
        """The real parameters: coordinates, numerator, and the friction where there is any."""
        friction = [self.friction] * bool(self.friction)
        return np.array([*self.coordinates, *self.numerator, *friction])

    def with_parameters(self, values: FloatArray) -> "LoopModel":
        """The model with other values of the real parameters and the same dead time."""
        numbers = [float(value) for value in values]
        n, end = self.order, self.order + len(self.numerator)
        return self._replace(
            coordinates=tuple(numbers[:n]),
            numerator=tuple(numbers[n:end]),
            friction=max(sum(numbers[end:]), 0.0),
        )

    @property
    def sections(self) -> tuple[PoleSection, ...]:
        """The poles in sections."""
        return sections_of(self.coordinates)

    @property
    def static_gain(self) -> float:
        """Measurement per effort at rest; infinite for an integrator."""
        unit = math.prod(float(section.powers[0]) for section in self.sections)
        return self.numerator[0] / unit if unit else math.inf

    @property
    def natural_period(self) -> float:
        """2 pi over the natural frequency of the first pair of poles, samples."""
        first = np.abs(self.sections[0].log_poles)
        return 2.0 * math.pi / float(np.sqrt(first[0] * first[-1]))

    @property
    def grows(self) -> bool:
        """Whether a pole lies outside the unit circle."""
        return any(section.grows for section in self.sections)


def exchanged(coefficients: FloatArray) -> FloatArray:
    """A polynomial in x as one in 1 - x, or back."""
    result, power = np.zeros(coefficients.size), np.ones(1)
    for coefficient in coefficients:
        result[: power.size] += coefficient * power
        power = np.convolve(power, [1.0, -1.0])
    return result


@lru_cache(maxsize=64)
def controller_law(settings: ControllerSettings, gains: Gains) -> ControllerPolynomials:
    """The controller's equation; without integral action its pole at one is left out."""
    law = controller_polynomials(settings, gains)
    if gains.I:
        return law
    return law._replace(
        setpoint=_summed(law.setpoint),
        measurement=_summed(law.measurement),
        denominator=_summed(law.denominator),
    )


def _summed(polynomial: FloatArray) -> FloatArray:
    """A polynomial in q^-1 over 1 - q^-1, which is a factor of it."""
    return np.cumsum(polynomial)[:-1]


class Laws(NamedTuple):
    """Equations of a controller with several gains, in powers of q^-1, (gains, terms) each.

    Attributes:
        setpoint: T.
        measurement: S.
        denominator: R.
        filters: Both terms of the numerator of F and the pole of it, shape (gains, 3).
    """

    setpoint: FloatArray
    measurement: FloatArray
    denominator: FloatArray
    filters: FloatArray

    @classmethod
    def of(cls, gains: Sequence[Gains], settings: ControllerSettings) -> "Laws":
        """The equations as `controller_law` has them: T and S are sums over P, I, D and I D/P."""
        shares = np.array([(g.P, g.I, g.D, g.I * g.D / g.P) for g in gains])
        basis, pole = law_basis(settings)
        # Row by row, so that a loop is the same whatever others it comes with.
        T, S = np.einsum("gk,skt->sgt", shares, basis)
        R = np.repeat(pole[np.newaxis], len(gains), axis=0)
        still = np.flatnonzero(shares[:, 1] == 0.0)
        if still.size:
            for each in (T, S, R):
                each[still] = np.cumsum(each[still], axis=1)
        form, h = settings.form or OWN_FORM, 1.0 / settings.sampling_Hz
        filters = np.array([filter_terms(form, h, one.setpoint_filter_s) for one in gains])
        return cls(T, S, R, filters)


@lru_cache(maxsize=16)
def law_basis(settings: ControllerSettings) -> tuple[FloatArray, FloatArray]:
    """T and S of P, I, D and I D/P, shape (2, 4, terms), and R, of as many terms."""
    at = [Gains(1.0, i, d, 0.0) for i, d in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
    forms = [controller_polynomials(settings, gains) for gains in at]
    terms = max(one.size for form in forms for one in form[:3])

    def padded(one: FloatArray) -> FloatArray:
        return np.pad(one, (0, terms - one.size))

    def parts(columns: Sequence[FloatArray]) -> FloatArray:
        of_p, p_i, p_d, p_i_d = map(padded, columns)
        return np.array([of_p, p_i - of_p, p_d - of_p, p_i_d - p_i - p_d + of_p])

    T, S = parts([form.setpoint for form in forms]), parts([form.measurement for form in forms])
    return np.array([T, S]), padded(forms[0].denominator)


class ClosedLoop(NamedTuple):
    """Polynomials in q^-1 of the loop with one set of gains.

    Attributes:
        characteristic: A R + q^-(d+1) B S; its zeros are the poles of the closed loop.
        forward: A R, so that forward / characteristic is the sensitivity.
        to_output: From the filtered setpoint to the output, over the characteristic.
        to_effort: From the filtered setpoint to the effort.
        numerator: q^-(d+1) B.
        denominator: R.
        feedback: q^-(d+1) B S.
        filter_numerator: Of the setpoint filter.
        filter_denominator: Of it.
    """

    characteristic: FloatArray
    forward: FloatArray
    to_output: FloatArray
    to_effort: FloatArray
    noise_to_effort: FloatArray
    numerator: FloatArray
    denominator: FloatArray
    feedback: FloatArray
    filter_numerator: FloatArray
    filter_denominator: FloatArray

    def setpoint_response(self, setpoint: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Output and effort for a setpoint, as deviations, without limits, shape (samples,)."""
        n = setpoint.size
        poles = np.convolve(self.filter_denominator, self.characteristic)
        common = lfilter(self.filter_numerator, poles, setpoint)
        output, effort = (np.convolve(common, b)[:n] for b in (self.to_output, self.to_effort))
        return output, effort

    def load_response(self, load: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Output and effort for a load at the plant's input, without limits, shape (samples,)."""
        return (
            lfilter(np.convolve(self.numerator, self.denominator), self.characteristic, load),
            -lfilter(self.feedback, self.characteristic, load),
        )

    def noise_response(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort for measurement noise, without limits, shape (samples,)."""
        return (
            lfilter(self.forward, self.characteristic, noise),
            lfilter(self.noise_to_effort, self.characteristic, noise),
        )

    def noise_gains(self, samples: int) -> tuple[float, float]:
        """Variance of the measurement and of one move of the effort, per variance of the noise."""
        impulse = np.zeros(samples)
        impulse[0] = 1.0
        poles = lfilter([1.0], self.characteristic, impulse)
        measured = np.convolve(poles, self.forward)[:samples]
        effort = np.convolve(poles, self.noise_to_effort)[:samples]
        moves = effort[1:] - effort[:-1]
        return float(measured @ measured), float(effort[0] ** 2 + moves @ moves)


@lru_cache(maxsize=64)
def plant_polynomials(model: LoopModel) -> tuple[FloatArray, FloatArray]:
    """A, and B with its dead time, in powers of q^-1."""
    B = np.concatenate([np.zeros(model.dead_samples + 1), exchanged(np.array(model.numerator))])
    return polynomial(model.coordinates), B


@lru_cache(maxsize=8)
def close_loop(model: LoopModel, gains: Gains, settings: ControllerSettings) -> ClosedLoop:
    """The closed loop of a model and a controller with these gains."""
    law = controller_law(settings, gains)
    A, B = plant_polynomials(model)
    forward, feedback = np.convolve(A, law.denominator), np.convolve(B, law.measurement)
    characteristic = np.zeros(max(forward.size, feedback.size))
    characteristic[: forward.size] += forward
    characteristic[: feedback.size] += feedback
    return ClosedLoop(
        characteristic=characteristic,
        forward=forward,
        to_output=np.convolve(B, law.setpoint),
        to_effort=np.convolve(A, law.setpoint),
        noise_to_effort=-np.convolve(A, law.measurement),
        numerator=B,
        denominator=law.denominator,
        feedback=feedback,
        filter_numerator=law.filter_numerator,
        filter_denominator=law.filter_denominator,
    )
