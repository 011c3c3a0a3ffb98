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
from numpy.typing import NDArray

from estune.core.controller_equation import ControllerPolynomials, controller_polynomials
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.poles import PoleSection, pair_coordinates, polynomial, sections_of

ComplexArray = NDArray[np.complex128]

GRID_POINTS = 250
LOWEST_rad = 1e-4
POINTS_PER_TURN = 24
"""Grid of the frequency response; Ms is refined between its points."""

_OCTAVES = 2.0 ** np.arange(-1.0, 7.5, 0.5)
ABOUT_A_POLE = np.concatenate([-_OCTAVES, [0.0], _OCTAVES])
"""Further points of the grid about each pole, in half widths of its resonance. Without them a mode
of damping 0.03 was read as Ms 1.60 for 1.84; with them modes of damping 0.001 as with 200 000
points to 0.3 %."""

ZOOMED = 25
"""Points of a second grid about the lowest |1 + L| of the first: resonances of the closed loop are
not those of the plant."""


class LoopModel(NamedTuple):
    """Poles, a numerator, a dead time and dry friction.

    Attributes:
        coordinates: Of the poles, as in `poles`.
        numerator: B in powers of 1 - q^-1, N of measurement per N of effort.
        dead_samples: Whole samples d of dead time beyond the one of sampling.
        friction_N: Size of the dry friction that the effort works against, N; zero is none. It
            acts on the first pair of poles. Margins are those of the linear part.
    """

    coordinates: tuple[float, ...]
    numerator: tuple[float, ...]
    dead_samples: int
    friction_N: float = 0.0

    @classmethod
    def of_taps(
        cls, poles: tuple[float, float], zeros: Sequence[float], dead_samples: int
    ) -> "LoopModel":
        """A model of two stable poles by the coefficients of its polynomials in q^-1.

        Args:
            poles: a1 and a2 of A = 1 + a1 q^-1 + a2 q^-2.
            zeros: Coefficients of B, the first of q^0.
            dead_samples: Whole samples of dead time.
        """
        coordinates = tuple(pair_coordinates(*poles).tolist())
        return cls(coordinates, tuple(exchanged(np.array(zeros)).tolist()), dead_samples)

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.coordinates)

    @property
    def parameters(self) -> FloatArray:
        """The real parameters: coordinates, numerator, and the friction where there is any."""
        friction = [self.friction_N] * bool(self.friction_N)
        return np.array([*self.coordinates, *self.numerator, *friction])

    def with_parameters(self, values: FloatArray) -> "LoopModel":
        """The model with other values of the real parameters and the same dead time."""
        numbers = [float(value) for value in values]
        n, end = self.order, self.order + len(self.numerator)
        return self._replace(
            coordinates=tuple(numbers[:n]),
            numerator=tuple(numbers[n:end]),
            friction_N=max(sum(numbers[end:]), 0.0),
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
        return 2.0 * math.pi / math.exp(self.coordinates[0])

    def frequency_response(self, theta: FloatArray) -> ComplexArray:
        """G(exp(i theta)) for angles in rad/sample, shape of theta."""
        return _ratio(self, np.exp(-1j * theta), -np.expm1(-1j * theta))[0]


def _ratio(
    model: LoopModel, later: ComplexArray, difference: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """G and A at q^-1 and 1 - q^-1."""
    poles = np.ones_like(later)
    for section in model.sections:
        poles = poles * _polynomial_at(section.powers, difference)
    zeros = _polynomial_at(np.array(model.numerator), difference)
    return later ** (model.dead_samples + 1) * zeros / poles, poles


def _polynomial_at(coefficients: FloatArray, x: ComplexArray) -> ComplexArray:
    value = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


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


class ClosedLoop(NamedTuple):
    """Polynomials in q^-1 of the loop with one set of gains.

    Attributes:
        characteristic: A R + q^-(d+1) B S; its zeros are the poles of the closed loop.
        forward: A R, so that forward / characteristic is the sensitivity.
        to_output: From the filtered setpoint to the output, over the characteristic.
        to_effort: From the filtered setpoint to the effort.
        noise_to_effort: From measurement noise to the effort.
        load_to_output: From a load at the plant's input to the output.
        load_to_effort: From it to the effort.
        filter_numerator: Of the setpoint filter.
        filter_denominator: Of it.
    """

    characteristic: FloatArray
    forward: FloatArray
    to_output: FloatArray
    to_effort: FloatArray
    noise_to_effort: FloatArray
    load_to_output: FloatArray
    load_to_effort: FloatArray
    filter_numerator: FloatArray
    filter_denominator: FloatArray

    def setpoint_response(self, setpoint_N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Output and effort for a setpoint, as deviations, without limits, shape (samples,)."""
        n = setpoint_N.size
        poles = np.convolve(self.filter_denominator, self.characteristic)
        common = lfilter(self.filter_numerator, poles, setpoint_N)
        output, effort = (np.convolve(common, b)[:n] for b in (self.to_output, self.to_effort))
        return output, effort

    def load_response(self, load_N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Output and effort for a load at the plant's input, without limits, shape (samples,)."""
        return (
            lfilter(self.load_to_output, self.characteristic, load_N),
            lfilter(self.load_to_effort, self.characteristic, load_N),
        )

    def noise_response(self, noise_N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measurement and effort for measurement noise, without limits, shape (samples,)."""
        return (
            lfilter(self.forward, self.characteristic, noise_N),
            lfilter(self.noise_to_effort, self.characteristic, noise_N),
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
def _plant_polynomials(model: LoopModel) -> tuple[FloatArray, FloatArray]:
    """A, and B with its dead time, in powers of q^-1."""
    B = np.concatenate([np.zeros(model.dead_samples + 1), exchanged(np.array(model.numerator))])
    return polynomial(model.coordinates), B


def close_loop(model: LoopModel, gains: Gains, settings: ControllerSettings) -> ClosedLoop:
    """The closed loop of a model and a controller with these gains."""
    law = controller_law(settings, gains)
    A, B = _plant_polynomials(model)
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
        load_to_output=np.convolve(B, law.denominator),
        load_to_effort=-feedback,
        filter_numerator=law.filter_numerator,
        filter_denominator=law.filter_denominator,
    )


class Robustness(NamedTuple):
    """Stability margins of the linear loop.

    Attributes:
        sensitivity: Ms, the largest |S| over frequency; infinite where the loop is unstable.
        phase_margin_deg: Smallest phase margin over all gain crossovers, degrees; infinite
            without a crossover, NaN where the loop is unstable.
    """

    sensitivity: float
    phase_margin_deg: float


UNSTABLE = Robustness(math.inf, math.nan)


class FrequencyGrid(NamedTuple):
    """Frequency responses that the margins are computed from, on a grid of angles; (angles,) each.

    Attributes:
        theta: Angles, rad/sample, from well below the loop's rates to half the sampling rate.
        later: q^-1 = exp(-i theta).
        plant: G.
        poles: A.
    """

    theta: FloatArray
    later: ComplexArray
    plant: ComplexArray
    poles: ComplexArray


@lru_cache(maxsize=64)
def frequency_grid(model: LoopModel) -> FrequencyGrid:
    """The grid of a model: logarithmic, finer for its dead time and about its resonances."""
    theta = _angles(model.dead_samples)
    resonances = [log for section in model.sections for log in section.log_poles if log.imag > 0]
    if resonances:
        widths = np.array([max(-log.real, 1e-6) for log in resonances])
        centres = np.array([log.imag for log in resonances])
        about = (centres[:, np.newaxis] + np.outer(widths, ABOUT_A_POLE)).ravel()
        theta = np.union1d(theta, about[(about > LOWEST_rad) & (about < math.pi)])
    later, difference = np.exp(-1j * theta), -np.expm1(-1j * theta)
    return FrequencyGrid(theta, later, *_ratio(model, later, difference))


@lru_cache(maxsize=16)
def _angles(dead_samples: int) -> FloatArray:
    """Angles of the grid of all models with a dead time."""
    turns = POINTS_PER_TURN * (dead_samples + 2) // 2
    return np.union1d(
        np.geomspace(LOWEST_rad, math.pi, GRID_POINTS), np.linspace(0.0, math.pi, turns)[1:]
    )


class LoopResponse(NamedTuple):
    """The loop on the grid of a model, shape (angles,) each.

    Attributes:
        theta: Angles, rad/sample.
        controller: C_y = S/R.
        loop: L.
        stable: Whether the closed loop is stable.
    """

    theta: FloatArray
    controller: ComplexArray
    loop: ComplexArray
    stable: bool


def loop_response(model: LoopModel, gains: Gains, settings: ControllerSettings) -> LoopResponse:
    """The loop of a model and a controller over frequency.

    The loop is stable where its characteristic polynomial in q^-1 has no zero within the unit
    circle. Its value at zero is above zero; so it is above zero at one, too, and makes no turn
    about the origin as theta goes from 0 to pi.
    """
    law, grid = controller_law(settings, gains), frequency_grid(model)
    R = _polynomial_at(law.denominator, grid.later)
    controller = _polynomial_at(law.measurement, grid.later) / R
    loop = grid.plant * controller
    poles = math.prod(float(section.powers[0]) for section in model.sections)
    at_one = poles * law.denominator.sum() + model.numerator[0] * law.measurement.sum()
    characteristic = (1.0 + loop) * grid.poles * R
    turn = np.angle(characteristic[1:] / characteristic[:-1])
    total = float(np.angle(characteristic[0]) + turn.sum())
    stable = at_one > 0.0 and abs(total) < math.pi / 2.0  # not with NaN
    return LoopResponse(grid.theta, controller, loop, stable)


def robustness(model: LoopModel, gains: Gains, settings: ControllerSettings) -> Robustness:
    """Ms and phase margin of the loop of a model and a controller."""
    theta, _, loop, stable = loop_response(model, gains, settings)
    if not stable:
        return UNSTABLE
    size = np.abs(1.0 + loop)
    lowest = int(np.argmin(size))
    if 0 < lowest < size.size - 1:
        law = controller_law(settings, gains)
        near = np.linspace(theta[lowest - 1], theta[lowest + 1], ZOOMED)
        later = np.exp(-1j * near)
        controller = _polynomial_at(law.measurement, later) / _polynomial_at(
            law.denominator, later
        )
        zoomed = np.abs(1.0 + _ratio(model, later, -np.expm1(-1j * near))[0] * controller)
        least = _refined(zoomed, int(np.argmin(zoomed)))
    else:
        least = float(size[lowest])
    magnitude = np.abs(loop)
    at = np.flatnonzero((magnitude[:-1] > 1.0) != (magnitude[1:] > 1.0))
    if not at.size:
        return Robustness(1.0 / least, math.inf)
    before, after = np.log(magnitude[at]), np.log(magnitude[at + 1])
    share = before / (before - after)
    margins = np.angle(-loop[at]) + share * np.angle(loop[at + 1] / loop[at])
    return Robustness(1.0 / least, float(np.degrees(np.abs(margins).min())))


def _refined(values: FloatArray, lowest: int) -> float:
    """Minimum of a parabola through the logarithms of a smallest value and its neighbours.

    Of the values themselves it falls below zero where one neighbour is far above the other.
    """
    if not (0 < lowest < values.size - 1 and values[lowest] > 0.0):
        return float(values[lowest])
    left, middle, right = np.log(values[lowest - 1 : lowest + 2]).tolist()
    bend = left - 2.0 * middle + right
    if bend <= 0.0:
        return float(values[lowest])
    return math.exp(middle - (left - right) ** 2 / (8.0 * bend))
