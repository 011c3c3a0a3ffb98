"""The PIDF controller, (32) to (34), discrete at the rig's sampling rate.

In continuous time, with setpoint r, measurement y and control effort u,

    C_y(s) = K (1 + 1/(Ti s) + Td s)                                    (32)
    C_r(s) = K (1 + 1/(Ti s))                                           (33)
    u = C_r F r - C_y y,  so that  T = F G C_r / (1 + G C_y)            (34)

Implements (32) to (34), with P = K, I = K/Ti, D = K Td and F = 1/(tau_F s + 1). The derivative
acts on the measurement alone. As stated after (34), the two terms do not run as two integrators,
whose difference would lose digits; the error is formed first and integrated once.

The functions use arithmetic and numpy's `exp`, `minimum` and `maximum` only, so that they serve
floats on the rig, arrays in a batch, and CasADi symbols in simulation, fit and export.
"""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput

Signal = Any
"""A float, an array, or a CasADi expression."""


@documented
@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """The part of the controller that is not tuned.

    Raises:
        InvalidInput: a value is out of its range, or the limits are the wrong way round.
    """

    sampling_Hz: Annotated[float, Setting("Sampling rate", "Hz", above=0.0)]
    derivative_filter_s: Annotated[
        float,
        Setting("Time constant of the first-order filter on the derivative", "s", least=0.0),
    ]
    # Infinite where the rig knows no limit.
    output_min_N: Annotated[
        float, Setting("Least control effort; known to the anti-windup", "N", infinite=True)
    ]
    output_max_N: Annotated[float, Setting("Greatest control effort", "N", infinite=True)]
    form: Annotated[
        ControllerForm | None,
        Field(exclude_if=lambda form: form is None),
        Setting("Form of the difference equation that runs; None where the rig declares none"),
    ] = None

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.output_min_N < self.output_max_N:
            raise InvalidInput(
                f"output limits {self.output_min_N} to {self.output_max_N} N: not in order"
            )


class Coefficients(NamedTuple):
    """The controller's difference equation, computed once per set of gains."""

    P: Signal
    I_per_sample: Signal  # I h
    D: Signal
    setpoint_pole: Signal  # exp(-h/tau_F), the exact discrete filter
    derivative_span_s: Signal  # tau_d + h, from the backward difference of s/(tau_d s + 1)
    sample_s: Signal
    tracking: Signal  # share of the excess taken out of the integral per sample
    output_min_N: Signal
    output_max_N: Signal


class PidfState(NamedTuple):
    """The state of the controller between samples."""

    integral: Signal
    filtered_setpoint: Signal
    filtered_measurement: Signal


def coefficients(settings: ControllerSettings, gains: Gains) -> Coefficients:
    """The difference equation of these gains at this sampling rate."""
    return symbolic_coefficients(settings, *gains.as_tuple())


def symbolic_coefficients(
    settings: ControllerSettings,
    P: Signal,
    I: Signal,
    D: Signal,
    setpoint_filter_s: Signal,
) -> Coefficients:
    """The difference equation of gains that may be arrays or CasADi symbols."""
    h = 1.0 / settings.sampling_Hz
    return Coefficients(
        P=P,
        I_per_sample=I * h,
        D=D,
        setpoint_pole=np.exp(-h / np.maximum(setpoint_filter_s, 1e-12)),
        derivative_span_s=settings.derivative_filter_s + h,
        sample_s=h,
        # Back-calculation with tracking time Ti = P/I, at most the whole excess at once.
        tracking=np.minimum(1.0, h * I / P),
        output_min_N=settings.output_min_N,
        output_max_N=settings.output_max_N,
    )


def step(
    c: Coefficients, state: PidfState, setpoint: Signal, measurement: Signal
) -> tuple[PidfState, Signal, Signal]:
    """One sample of the controller.

    Args:
        c: The difference equation.
        state: After the last sample.
        setpoint: Setpoint r before its filter.
        measurement: Measurement y.

    Returns:
        The next state, the effort within its limits, and the excess beyond them.
    """
    r, error, derivative = _terms(c, state, setpoint, measurement)
    effort, excess = limit_effort(c, c.P * error + state.integral - c.D * derivative)
    following = PidfState(
        integral=state.integral + c.I_per_sample * error - c.tracking * excess,
        filtered_setpoint=r,
        filtered_measurement=state.filtered_measurement + c.sample_s * derivative,
    )
    return following, effort, excess


def limit_effort(c: Coefficients, wanted: Signal) -> tuple[Signal, Signal]:
    """An effort within the controller's limits, and the excess beyond them."""
    effort = np.minimum(np.maximum(wanted, c.output_min_N), c.output_max_N)
    return effort, wanted - effort


def state_at_rest(measurement: Signal, effort: Signal) -> PidfState:
    """The state of a loop settled at a tension with a constant effort."""
    return PidfState(effort, measurement, measurement)


def bumpless(
    c: Coefficients, state: PidfState, setpoint: Signal, measurement: Signal, effort: Signal
) -> PidfState:
    """The state from which the next `step` gives exactly `effort`.

    Only the integral moves, because the filters do not depend on the gains.
    """
    _, error, derivative = _terms(c, state, setpoint, measurement)
    return state._replace(integral=effort - c.P * error + c.D * derivative)


def bumpless_exchange(
    before: Coefficients,
    after: Coefficients,
    state: PidfState,
    setpoint: Signal,
    measurement: Signal,
) -> PidfState:
    """The state from which the next `step` with new gains gives the effort of the old ones.

    For gains that follow a schedule: `bumpless` to the last effort at every sample would freeze
    the effort.
    """
    _, error, derivative = _terms(before, state, setpoint, measurement)
    effort = before.P * error + state.integral - before.D * derivative
    return bumpless(after, state, setpoint, measurement, effort)


def _terms(
    c: Coefficients, state: PidfState, setpoint: Signal, measurement: Signal
) -> tuple[Signal, Signal, Signal]:
    """Filtered setpoint, error, and filtered derivative of the measurement."""
    r = c.setpoint_pole * state.filtered_setpoint + (1.0 - c.setpoint_pole) * setpoint
    derivative = (measurement - state.filtered_measurement) / c.derivative_span_s
    return r, r - measurement, derivative
