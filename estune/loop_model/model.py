"""A discrete linear model of the plant, and the closed loop it forms with the PIDF.

With q^-1 the backward shift, h the sampling interval, d whole samples of dead time,

    y = G u,      G = q^-(d+1) B / A,    A = 1 + a1 q^-1 + a2 q^-2,   B = b0 + b1 q^-1 + b2 q^-2
    u = Cr F r - Cy y                                                                 (32) to (34)
    Cr = Sr / Ni,          Sr = P Ni + I h q^-1,                         Ni = 1 - q^-1
    Cy = Sy / (Ni Nd),     Sy = Sr Nd + D Ni^2,                Nd = (tau_d + h) - tau_d q^-1

which is the difference equation of `estune.core.pidf` within its limits. All signals are
deviations from the steady state before the step.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray

ComplexArray = NDArray[np.complex128]

GRID_POINTS = 250
LOWEST_rad = 1e-4
POINTS_PER_TURN = 24
"""Grid of the frequency response; Ms is refined between its points."""


class LoopModel(NamedTuple):
    """Two poles, three numerator terms, a dead time and dry friction.

    Attributes:
        poles: a1 and a2.
        zeros: b0, b1 and b2, N of measurement per N of effort.
        dead_samples: Whole samples d of dead time beyond the one of sampling.
        friction_N: Size of the dry friction that the effort works against, N; zero is none. The
            polynomials and margins are those of the linear part.
    """

    poles: tuple[float, float]
    zeros: tuple[float, float, float]
    dead_samples: int
    friction_N: float = 0.0

    @property
    def parameters(self) -> FloatArray:
        """The real parameters, shape (5,), or (6,) with the friction as the last."""
        return np.array([*self.poles, *self.zeros, *([self.friction_N] * bool(self.friction_N))])

    def with_parameters(self, values: FloatArray) -> "LoopModel":
        """The model with other values of the real parameters and the same dead time."""
        a1, a2, b0, b1, b2, *friction = (float(value) for value in values)
        return LoopModel((a1, a2), (b0, b1, b2), self.dead_samples, max(sum(friction), 0.0))

    @property
    def static_gain(self) -> float:
        """Measurement per effort at rest; infinite for an integrator."""
        unit = 1.0 + sum(self.poles)
        return sum(self.zeros) / unit if unit else math.inf

    @property
    def numerator(self) -> FloatArray:
        """q^-(d+1) B as a polynomial in q^-1."""
        return np.concatenate([np.zeros(self.dead_samples + 1), self.zeros])

    @property
    def denominator(self) -> FloatArray:
        """A as a polynomial in q^-1."""
        return np.array([1.0, *self.poles])

    @property
    def natural_period(self) -> float:
        """2 pi over the natural frequency of the poles, samples; infinite for an integrator."""
        roots = np.roots(self.denominator).astype(complex)
        one, other = np.log(np.maximum(np.abs(roots), 1e-300)) + 1j * np.angle(roots)
        frequency = math.sqrt(abs(one * other))
        return 2.0 * math.pi / frequency if frequency > 0.0 else math.inf

    def frequency_response(self, theta: FloatArray) -> ComplexArray:
        """G(exp(i theta)) for angles in rad/sample, shape of theta."""
        later = np.exp(-1j * theta)
        (a1, a2), (b0, b1, b2) = self.poles, self.zeros
        numerator = later ** (self.dead_samples + 1) * (b0 + later * (b1 + later * b2))
        return np.asarray(numerator / (1.0 + later * (a1 + later * a2)))


class ClosedLoop(NamedTuple):
    """Polynomials in q^-1 of the loop with one set of gains.

    Attributes:
        characteristic: A Ni Nd + q^-(d+1) B Sy; its zeros are the poles of the closed loop.
        forward: A Ni Nd, so that S = forward / characteristic is the sensitivity.
        to_output: From the filtered setpoint to the output, over the characteristic.
        to_effort: From the filtered setpoint to the effort.
        noise_to_effort: From measurement noise to the effort.
        load_to_output: From a load at the plant's input to the output.
        load_to_effort: From it to the effort.
        setpoint_pole: Pole of the setpoint filter F.
    """

    characteristic: FloatArray
    forward: FloatArray
    to_output: FloatArray
    to_effort: FloatArray
    noise_to_effort: FloatArray
    load_to_output: FloatArray
    load_to_effort: FloatArray
    setpoint_pole: float

    def step_response(self, setpoint_N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Output and effort for a setpoint, as deviations, without limits, shape (samples,)."""
        p, n = self.setpoint_pole, setpoint_N.size
        poles = np.convolve([1.0, -p], self.characteristic)
        common = lfilter([1.0 - p], poles, setpoint_N)
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


def close_loop(model: LoopModel, gains: Gains, settings: ControllerSettings) -> ClosedLoop:
    """The closed loop of a model and a PIDF with these gains."""
    h, lag = 1.0 / settings.sampling_Hz, settings.derivative_filter_s
    Ni, Nd = np.array([1.0, -1.0]), np.array([lag + h, -lag])
    Sr = gains.P * Ni + np.array([0.0, gains.I * h])
    Sr_Nd = np.convolve(Sr, Nd)
    Sy = Sr_Nd + gains.D * np.convolve(Ni, Ni)
    A, B = model.denominator, model.numerator
    forward = np.convolve(A, np.convolve(Ni, Nd))
    feedback = np.convolve(B, Sy)
    characteristic = np.zeros(max(forward.size, feedback.size))
    characteristic[: forward.size] += forward
    characteristic[: feedback.size] += feedback
    return ClosedLoop(
        characteristic=characteristic,
        forward=forward,
        to_output=np.convolve(B, Sr_Nd),
        to_effort=np.convolve(A, Sr_Nd),
        noise_to_effort=-np.convolve(A, Sy),
        load_to_output=np.convolve(B, np.convolve(Ni, Nd)),
        load_to_effort=-feedback,
        setpoint_pole=math.exp(-h / max(gains.setpoint_filter_s, 1e-12)),
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
        difference: Ni = 1 - q^-1, with all its digits at low frequency.
        plant: G.
        poles: A.
    """

    theta: FloatArray
    later: ComplexArray
    difference: ComplexArray
    plant: ComplexArray
    poles: ComplexArray


@lru_cache(maxsize=64)
def frequency_grid(model: LoopModel) -> FrequencyGrid:
    """The grid of a model: logarithmic, with `POINTS_PER_TURN` to a turn of its dead time."""
    theta, later, difference = _angles(model.dead_samples)
    a1, a2 = model.poles
    plant, poles = model.frequency_response(theta), 1.0 + later * (a1 + later * a2)
    return FrequencyGrid(theta, later, difference, plant, poles)


@lru_cache(maxsize=16)
def _angles(dead_samples: int) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Angles, q^-1 and 1 - q^-1 of the grid of all models with a dead time."""
    turns = POINTS_PER_TURN * (dead_samples + 2) // 2
    theta = np.union1d(
        np.geomspace(LOWEST_rad, math.pi, GRID_POINTS), np.linspace(0.0, math.pi, turns)[1:]
    )
    return theta, np.exp(-1j * theta), -np.expm1(-1j * theta)


def robustness(model: LoopModel, gains: Gains, settings: ControllerSettings) -> Robustness:
    """Ms and phase margin of the loop of a model and a PIDF.

    The loop is stable where its characteristic polynomial in q^-1 makes no turn about the origin
    as theta goes from 0 to pi.
    """
    h, lag = 1.0 / settings.sampling_Hz, settings.derivative_filter_s
    grid = frequency_grid(model)
    Nd = (lag + h) - lag * grid.later
    controller = (
        gains.P + gains.I * h * grid.later / grid.difference + gains.D * grid.difference / Nd
    )
    loop = grid.plant * controller
    back = 1.0 + loop
    characteristic = back * grid.poles * grid.difference * Nd
    turn = np.angle(characteristic[1:] / characteristic[:-1])
    # At theta = 0 the polynomial is real; its angle from there to the first point is counted too.
    total = float(np.angle(characteristic[0]) + turn.sum())
    if not math.isfinite(total) or abs(total) > math.pi / 2.0:
        return UNSTABLE
    size = np.abs(back)
    lowest = int(np.argmin(size))
    magnitude = np.abs(loop)
    at = np.flatnonzero((magnitude[:-1] > 1.0) != (magnitude[1:] > 1.0))
    if not at.size:
        return Robustness(1.0 / _refined(size, lowest), math.inf)
    before, after = np.log(magnitude[at]), np.log(magnitude[at + 1])
    share = before / (before - after)
    margins = np.angle(-loop[at]) + share * np.angle(loop[at + 1] / loop[at])
    return Robustness(1.0 / _refined(size, lowest), float(np.degrees(np.abs(margins).min())))


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
