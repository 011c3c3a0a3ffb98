"""Largest integral gain within limits of sensitivity, setpoint response and noise.

1/I is the integral of the error after a load step, so that the largest I rejects loads best. The
constraints `|1 + L| >= 1/M_s` and `|1 + L| >= I |G/s|/M_t` over frequency are not convex in the
gains, but L is linear in them. Each round replaces |1 + L| by its tangent at the last gains, which
lies below it, and solves the linear programme (convex-concave procedure: Hast, Astrom,
Bernhardsson & Boyd, PID design by convex-concave optimization, European Control Conference 2013).
The rounds begin at nearly no gain, and 1 + L never passes zero, so that the loop of a stable plant
stays stable. On a reel P is near one and I falls with the length of the cable.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from estune.core.gains import Gains
from estune.core.margins import SampledPlant, controller_response, sensitivity_grid
from estune.core.pidf import ControllerSettings
from estune.core.quantities import ComplexArray, FloatArray
from estune.errors import InvalidInput

ROUNDS = 60

SENSITIVITY_MAX = 1.6
"""M_s, the greatest |1/(1 + L)|: 1.4 is robust, 2 aggressive."""
SETPOINT_PEAK_MAX = 1.02
"""M_t, the greatest |T| from setpoint to output through the filter: 1 is no resonance."""
NOISE_GAIN_MAX = 8.0
"""Greatest C_y at half the sampling rate, N of effort per N of noise."""


class _SlowestMode(NamedTuple):
    """Static gain and slowest mode of the plant, which scale the gains."""

    gain: float
    frequency_rad_s: float
    damping: float

    @classmethod
    def of(cls, plant: SampledPlant, sample_s: float) -> Self:
        if (plant.modes.real > 0.0).any():
            raise InvalidInput(
                "the model is unstable by itself, and the rule begins at nearly no gain; give "
                "initial gains that stabilise it"
            )
        mode = complex(min(plant.modes, key=abs))
        if mode == 0.0:
            raise InvalidInput(
                "the model integrates, so that it has no static gain; give initial gains"
            )
        drive = np.linalg.solve(np.eye(plant.C.size) - plant.Phi, plant.now + plant.before)
        gain = float(plant.C @ drive + plant.E)
        if not gain > 0.0:
            raise InvalidInput(
                f"the model's static gain is {gain:.4g}; it must be above zero, as the "
                "controller's gains are, so turn the sign of the input"
            )
        return cls(gain, abs(mode) / sample_s, max(-mode.real / abs(mode), 0.0))


def largest_integral_gain(plant: SampledPlant, settings: ControllerSettings) -> Gains:
    """The gains with the largest I within the limits; the setpoint filter is P/I.

    Args:
        plant: Any linear plant from effort to output, sampled as the controller is.
        settings: Sampling rate and derivative filter.

    Raises:
        InvalidInput: no gains keep the limits, or the plant is unstable by itself or has no
            positive static gain.
    """
    from scipy.optimize import linprog  # noqa: PLC0415  slow to import

    slowest = _SlowestMode.of(plant, 1.0 / settings.sampling_Hz)
    constraints = _Constraints.of(plant, slowest, settings)
    # P stays above zero, so that it has a logarithm even where the best is none.
    least = 0.01 * slowest.damping
    x = np.array([least, 0.01 * least, 0.0])
    for _ in range(ROUNDS):
        rows, room = constraints.tangent(x)
        solution = linprog(
            [0.0, -1.0, 0.0],
            A_ub=rows,
            b_ub=room,
            bounds=[(least, None), (0.0, None), (0.0, None)],
        )
        if not solution.success:
            raise InvalidInput(
                f"no gains keep the sensitivity at {SENSITIVITY_MAX:g} for a damping ratio of "
                f"{slowest.damping:.3g}; use another rule"
            )
        x, last = solution.x, x
        if x[1] - last[1] < 1e-4 * x[1]:
            break
    P, I, D = (float(value) for value in x * constraints.scale)
    return Gains(P, I, D, P / I)


@dataclass(frozen=True, slots=True, eq=False)
class _Constraints:
    """Constraints on the scaled gains (P, I, D).

    Attributes:
        scale: Of the gains, shape (3,).
        loop: L per unit of each gain, shape (frequencies, 3).
        setpoint: |G/s| per unit of the integral gain, over M_t, shape (frequencies,).
        noise: C_y at half the sampling rate per unit of each gain, shape (3,).
    """

    scale: FloatArray
    loop: ComplexArray
    setpoint: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, plant: SampledPlant, slowest: _SlowestMode, settings: ControllerSettings) -> Self:
        theta = sensitivity_grid(plant)
        controller = np.column_stack([_unit_response(n, settings, theta) for n in range(3)])
        w = slowest.frequency_rad_s
        scale = np.array([1.0, w, 1.0 / w]) / slowest.gain
        loop = plant.response(theta)[:, None] * controller * scale
        # The filter takes the zero out of C_r = (P s + I)/s, so that |T| = |I G/s| / |1 + L|.
        setpoint = np.abs(loop[:, 1]) / SETPOINT_PEAK_MAX
        return cls(scale, loop, setpoint, controller[-1].real * scale)

    def tangent(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The half spaces `rows x <= room` tangent to the constraints at these gains."""
        back = 1.0 + self.loop @ x
        toward = back.conj() / np.abs(back)
        # |1 + L| >= Re(toward (1 + L)), and equal at x.
        away, room = -(toward[:, None] * self.loop).real, toward.real
        with_setpoint = away + np.outer(self.setpoint, [0.0, 1.0, 0.0])
        return (
            np.vstack([away, with_setpoint, self.noise]),
            np.concatenate([room - 1.0 / SENSITIVITY_MAX, room, [NOISE_GAIN_MAX]]),
        )


def _unit_response(n: int, settings: ControllerSettings, theta: FloatArray) -> ComplexArray:
    """Response of the controller to one of P, I, D at one and the others at zero.

    `Gains` keeps P above zero, so that I and D follow from a difference.
    """
    only_P = controller_response(Gains(1.0, 0.0, 0.0, 0.0), settings, theta)
    if n == 0:
        return only_P
    both = Gains(1.0, 1.0, 0.0, 0.0) if n == 1 else Gains(1.0, 0.0, 1.0, 0.0)
    return controller_response(both, settings, theta) - only_P
