"""Stability and margins of the sampled loop: the plant with its dead time, and the PIDF.

The plant is exact under zero-order hold, with the dead time split into whole samples and a
fraction of one (Astrom & Wittenmark, Computer-Controlled Systems, section on sampling a system
with time delay); the controller is its own difference equation. Polynomials would lose all their
digits for a fast-sampled plant or a long dead time. So the crossings are taken from the frequency
response of the loop, and stability from the winding number of its return difference (Nyquist).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import ComplexArray, FloatArray

Response = Callable[[FloatArray], ComplexArray]
"""A function of the angle theta = omega h on the unit circle, rad/sample."""

POINTS_PER_DECADE = 100
POINTS_PER_TURN = 20
"""Grid per turn of z^-d, with d the dead time in samples."""
FINEST_TURN_rad = math.pi / 8.0
"""The grid is halved where a response turns by more from one point to the next."""
FINEST_STEP = 1e-8
"""Least interval of the grid, as a share of its angle."""
LEAST_GAIN = 1e-6
"""Below this loop gain, a gain margin of a million, crossings are noise and are ignored."""
SENSITIVITY_POINTS = 600
"""Frequencies at which the sensitivity is computed, beside those about the modes."""
SLOWEST = 1e-9
"""Below this size, per sample, a mode is an integrator's, whose zero is rounded."""


class Margins(NamedTuple):
    """Stability margins of a loop; all but `stable` are NaN if it is unstable.

    Attributes:
        gain_margin: Factor on the loop gain at which stability is lost, the nearest to one;
            below one for a conditionally stable loop, infinite if there is none.
        phase_margin_deg: Change of the loop's phase at which stability is lost, the smallest over
            all gain crossovers, degrees; infinite if there are none.
        gain_crossover_Hz: Frequency of the phase margin, where the loop gain is one; NaN if none.
        phase_crossover_Hz: Frequency of the gain margin, where the phase is -180 degrees; NaN if
            none.
    """

    gain_margin: float
    phase_margin_deg: float
    gain_crossover_Hz: float
    phase_crossover_Hz: float
    stable: bool


@dataclass(frozen=True, slots=True)
class SampledPlant:
    """A plant under zero-order hold, measured just before each new command takes effect.

    `x_{k+1} = Phi x_k + now u_{k-d} + before u_{k-d-1}`,  `y_k = C x_k + E u_{k-d-1}`

    Attributes:
        Phi: exp(A h), shape (n, n).
        now: Input vector of the command at the end of the interval, shape (n,).
        before: Input vector of the command at its beginning, shape (n,).
        C: Output vector, shape (n,).
        E: Direct feed-through.
        delay: Whole samples d of dead time.
        modes: Poles a of the plant times h, shape (n,); Phi has the eigenvalues exp(a h).
    """

    Phi: FloatArray
    now: FloatArray
    before: FloatArray
    C: FloatArray
    E: float
    delay: int
    modes: ComplexArray

    def response(self, theta: FloatArray) -> ComplexArray:
        """G(exp(i theta)), shape of theta."""
        later = np.exp(-1j * theta)  # 1/z
        parts = np.array_split(later, max(1, later.size * self.C.size**2 // 2**20))
        states = [self._states(part) for part in parts]
        return np.asarray((np.concatenate(states) @ self.C + self.E * later) * later**self.delay)

    def _states(self, later: ComplexArray) -> ComplexArray:
        resolvent = np.eye(self.C.size) / later[:, None, None] - self.Phi
        drive = self.now + self.before * later[:, None]
        return np.asarray(np.linalg.solve(resolvent, drive[:, :, None])[:, :, 0])


def sample_plant(
    A: FloatArray, B: FloatArray, C: FloatArray, E: float, *, dead_time_s: float, sample_s: float
) -> SampledPlant:
    """The plant `x' = A x + B u, y = C x + E u`, u late by the dead time, under zero-order hold.

    Args:
        A: State matrix, shape (n, n), 1/s.
        B: Input vector, shape (n,).
        C: Output vector, shape (n,).
        E: Direct feed-through.
        dead_time_s: Delay of the whole input, s; any number of samples or fraction.
        sample_s: Sample interval h, s.
    """
    delay = math.floor(dead_time_s / sample_s + 1e-9)  # a whole number in spite of rounding
    fraction_s = max(0.0, dead_time_s - delay * sample_s)
    to_end, held_new = _hold(A, B, sample_s - fraction_s)
    _, held_old = _hold(A, B, fraction_s)
    Phi, _ = _hold(A, B, sample_s)
    modes = np.linalg.eigvals(A).astype(np.complex128) * sample_s
    return SampledPlant(Phi, held_new, to_end @ held_old, C, E, delay, modes)


def _hold(A: FloatArray, B: FloatArray, span_s: float) -> tuple[FloatArray, FloatArray]:
    """exp(A t) and the integral of exp(A s) B over 0..t."""
    from scipy.linalg import expm  # noqa: PLC0415  slow to import

    n = B.size
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = A * span_s, B * span_s
    both = expm(both)
    return both[:n, :n], both[:n, n]


def controller_response(
    gains: Gains, settings: ControllerSettings, theta: FloatArray
) -> ComplexArray:
    """C_y(exp(i theta)) of the difference equation in `estune.core.pidf`, within its limits.

    `C_y(z) = P + I h/(z - 1) + D (z - 1)/((tau_d + h) z - tau_d)`
    """
    h, lag = 1.0 / settings.sampling_Hz, settings.derivative_filter_s
    difference = np.expm1(1j * theta)  # z - 1, with all its digits at low frequency
    derivative = difference / (h + (lag + h) * difference)
    return np.asarray(gains.P + gains.I * h / difference + gains.D * derivative)


def is_stable(plant: SampledPlant, gains: Gains, settings: ControllerSettings) -> bool:
    """Whether the closed loop is stable."""
    loop, without_poles = _responses(plant, gains, settings)
    theta = _resolved(_grid(plant, gains, settings), loop, without_poles)
    return _is_stable((1.0 + loop(theta)) * without_poles(theta))


def _responses(
    plant: SampledPlant, gains: Gains, settings: ControllerSettings
) -> tuple[Response, Response]:
    """The loop L, and a product of its poles' factors, as functions of the angle."""

    def loop(theta: FloatArray) -> ComplexArray:
        return controller_response(gains, settings, theta) * plant.response(theta)

    def without_poles(theta: FloatArray) -> ComplexArray:
        """The product of (1 - pole/z) over the poles of L, but that of the derivative.

        That pole is inside the unit circle: its factor makes no turn.
        """
        integrator = -np.expm1(-1j * theta) if gains.I > 0.0 else 1.0
        factors = -np.expm1(plant.modes[:, None] - 1j * theta)
        return np.asarray(integrator * factors.prod(axis=0))

    return loop, without_poles


def loop_margins(plant: SampledPlant, gains: Gains, settings: ControllerSettings) -> Margins:
    """The margins of the loop `L = C_y G`, cut at the plant's input.

    The setpoint filter is outside the loop and changes nothing here.
    """
    loop, without_poles = _responses(plant, gains, settings)
    theta = _resolved(_grid(plant, gains, settings), loop, without_poles)
    response = loop(theta)
    if not _is_stable((1.0 + response) * without_poles(theta)):
        return Margins(math.nan, math.nan, math.nan, math.nan, stable=False)
    gain_theta = _roots(lambda angle: np.abs(loop(angle)) - 1.0, theta, np.abs(response) - 1.0)
    phase_theta = _roots(lambda angle: loop(angle).imag, theta, response.imag)
    # On the real axis of z the loop is real: at half the sampling rate, and at rest if finite.
    ends = theta[-1:] if gains.I > 0.0 or not plant.modes.all() else theta[[0, -1]]
    gain, gain_Hz = _gain_margin(loop, np.append(phase_theta, ends))
    phase, phase_Hz = _phase_margin(loop, gain_theta)
    per_sample = settings.sampling_Hz / (2.0 * math.pi)
    return Margins(gain, phase, phase_Hz * per_sample, gain_Hz * per_sample, stable=True)


def _gain_margin(loop: Response, theta: FloatArray) -> tuple[float, float]:
    """The factor nearest to one, and its angle, among the crossings of the negative real axis."""
    response = loop(theta)
    crossing = (response.real < 0.0) & (np.abs(response) > LEAST_GAIN)
    if not crossing.any():
        return math.inf, math.nan
    factors = 1.0 / np.abs(response[crossing])
    nearest = int(np.abs(np.log(factors)).argmin())
    return float(factors[nearest]), float(theta[crossing][nearest])


def _phase_margin(loop: Response, theta: FloatArray) -> tuple[float, float]:
    """The smallest turn to -180 degrees, and its angle, among the crossings of the unit circle."""
    if theta.size == 0:
        return math.inf, math.nan
    turns = np.abs(np.angle(-loop(theta), deg=True))
    nearest = int(turns.argmin())
    return float(turns[nearest]), float(theta[nearest])


def _grid(plant: SampledPlant, gains: Gains, settings: ControllerSettings) -> FloatArray:
    """Angles from well below the loop's slowest rate to half the sampling rate, rad/sample."""
    rates = np.abs(plant.modes[plant.modes != 0.0])
    low = float(np.clip(1e-3 * rates.min(initial=1.0), 1e-9, 1e-5))
    if gains.I > 0.0:  # the closed loop's own slow pole, h I G/(1 + P G) at low frequency
        at_rest = abs(plant.response(np.array([low]))[0])
        slow = gains.I / settings.sampling_Hz * at_rest / (1.0 + gains.P * at_rest)
        low = float(np.clip(1e-3 * slow, 1e-12, low))
    decades = math.ceil(math.log10(math.pi / low))
    turns = POINTS_PER_TURN * (plant.delay + 2) // 2
    # Beside each mode, so that one nearly cancelled by a zero is resolved; never on it, where the
    # loop of an undamped pole is infinite. No halving of these offsets ends at zero.
    modes = np.abs(np.angle(np.exp(1j * plant.modes.imag)))
    width = np.maximum(np.abs(plant.modes.real), 1e-4 * np.abs(plant.modes))
    beside = (modes + width * np.array([[-2.0], [-0.5], [0.6], [2.3]])).ravel()
    even = np.concatenate(
        [
            np.geomspace(low, math.pi, POINTS_PER_DECADE * decades)[:-1],
            np.linspace(0.0, math.pi, turns + 1)[1:-1],
        ]
    )
    clear = (np.abs(even[:, None] - modes) > 1e-5 * modes).all(axis=1)
    inside = (beside > low) & (beside < math.pi)
    return np.unique(np.concatenate([even[clear], beside[inside], [math.pi]]))


def _resolved(theta: FloatArray, loop: Response, without_poles: Response) -> FloatArray:
    """The grid, halved until neither the loop nor its return difference turns far in a step."""
    while True:
        response = loop(theta)
        seen = np.abs(response) > LEAST_GAIN
        rough = _turns((1.0 + response) * without_poles(theta)) > FINEST_TURN_rad
        rough |= (_turns(response) > FINEST_TURN_rad) & seen[:-1] & seen[1:]
        # An undamped pole turns the loop at once, however fine the grid.
        rough &= np.diff(theta) > FINEST_STEP * theta[1:]
        if not rough.any():
            return theta
        theta = np.sort(np.append(theta, (theta[:-1] + theta[1:])[rough] / 2.0))


def _turns(response: ComplexArray) -> FloatArray:
    """Angle between successive points of a response, rad, without sign; NaN about zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(np.angle(response[1:] / response[:-1]))


def _is_stable(return_difference: ComplexArray) -> bool:
    """Whether no zero of the return difference, less its poles, is on or outside the unit circle.

    As a function of 1/z it has no poles inside the circle, so that the turns it makes about the
    origin count its zeros there; on the half circle from 0 to pi each real zero counts pi.
    """
    steps = np.angle(return_difference[1:] / return_difference[:-1])
    return bool((np.abs(steps) < math.pi / 2.0).all() and abs(steps.sum()) < math.pi / 4.0)


def _roots(
    function: Callable[[FloatArray], FloatArray], theta: FloatArray, values: FloatArray
) -> FloatArray:
    """Sign changes of the function between neighbours of the grid, by bisection."""
    change = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    low, high, sign = theta[change], theta[change + 1], np.sign(values[change])
    for _ in range(60):
        middle = (low + high) / 2.0
        same = np.sign(function(middle)) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return low


def largest_sensitivity(plant: SampledPlant, gains: Gains, settings: ControllerSettings) -> float:
    """Ms, the largest |1/(1 + L)| over frequency; infinite where the loop is unstable."""
    if not is_stable(plant, gains, settings):
        return math.inf
    theta = sensitivity_grid(plant)
    loop = controller_response(gains, settings, theta) * plant.response(theta)
    return float(1.0 / np.abs(1.0 + loop).min())


def sensitivity_grid(plant: SampledPlant) -> FloatArray:
    """Angles from well below the slowest mode to half the sampling rate, dense about the modes."""
    sizes = np.abs(plant.modes)
    # An integrator has the mode zero, below which there is nothing.
    slowest = sizes.min(initial=1.0, where=sizes > SLOWEST)
    wide = np.geomspace(1e-3 * slowest, math.pi, SENSITIVITY_POINTS)
    upper = plant.modes[(plant.modes.imag >= 0.0) & (sizes > SLOWEST)]
    dense = np.abs(upper)[:, None] - upper.real[:, None] * np.linspace(-4.0, 4.0, 81)
    joined = np.concatenate([wide, dense.ravel()])
    # Rounding may put a point of a mode of damping 0.25 beside zero, where the loop is infinite.
    inside = (joined >= wide[0]) & (joined < math.pi)
    return np.unique(np.append(joined[inside], math.pi))
