"""The cost of a step response, (35).

With the error eps = r - y, the step dT and the time t measured from the step,

    eta = N(eps) / N(eps_1)                                                              (35)
    N(eps) = int t eps^2 dt + 1/t_s int_0^{t_s} eps^2 / (1 + exp(pi (t - t_s)/(2 t_s))) dt

Implements (35), where eps_1 = dT exp(-4 t/t_s) is the error of a first-order system that settles
within 2 % in the desired time t_s. So eta depends on neither the size nor the sign of the step,
and eta = 1 means "as good as first order". Where the setpoint moves in a ramp, eps_1 is the error
of the same system on that ramp, so that 1 means the same. The paper advises t_s <= 2 pi / omega_n,
with omega_n the plant's natural frequency in rad/s.

The paper contradicts itself in two places, both options here:

* The printed sigmoid falls with time, from 0.83 at the step to 0.5 at t_s, and so weights the
  transient most; the prose de-emphasises the transient. `weight="rising"` is the prose: the
  mirrored sigmoid, from 0.17 to 0.5.
* The printed terms have different units, s^2 N^2 and N^2, so that their balance depends on the
  unit of time. `time_unit="settling_time"` puts t in units of t_s, so that eta is the same for a
  fast and a slow loop of the same shape; "second" is as printed, with t in s.

The printed cost does not penalise control effort, and its optimum often lies at infinite gain. An
optional control-move penalty, `+ w sum((du_k/dT)^2)` over the samples from the step on, makes it
interior. It is a sum, not an integral, so w belongs to one sampling rate.

Other costs are formed in the same way, as a criterion of the error over that of the first-order
reference: ITAE, `int t |eps| dt`, and ISE, `int eps^2 dt`, with a price on the effort,

    rho/t_s int ((u - u_end)/dT)^2 dt,

where u_end is the mean of the last tenth of the samples. With a load step d at the plant's input
the same criterion of eps/d from the load on is the cost of rejection; a share r weighs it against
that of tracking. A Python function of the response replaces all of these.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from estune.core.quantities import FloatArray, check_positive
from estune.core.response import (
    CostFunction,
    StepResponse,
    StepShape,
    cost_function,
    evaluate_function,
    reference_of,
)
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "paper": {},
    "itae": {"criterion": "itae"},
    "ise": {"criterion": "ise", "effort_weight": 0.1},
    "rejection": {"criterion": "itae", "rejection": 1.0},
    "tracking_and_rejection": {"criterion": "itae", "rejection": 0.5},
}
"""Costs by name: settings beside those of the default cost."""

MOVE_WEIGHT = 0.2
"""Default control-move penalty: without it, (35) has no interior optimum on a good plant."""


_PRESET = "that of the preset"


@documented
@dataclass(frozen=True, slots=True)
class StepCost:
    """The settings of (35), or of another cost.

    An `unscaled` cost weighs the effort in its own unit; the first record of a plant gives the
    scale.

    Raises:
        InvalidInput: a value is out of its range or not among the choices.
    """

    settling_time_s: Annotated[
        float,
        Setting(
            "Desired settling time t_s, at most the time recorded after the step",
            "s",
            otherwise="as the rig suggests",
            above=0.0,
        ),
    ]
    weight: Annotated[
        Literal["printed", "rising"],
        Setting("Weight over the transient: as the paper prints it, or rising as its text says"),
    ] = "printed"
    time_unit: Annotated[
        Literal["second", "settling_time"],
        Setting("Unit of the time weight: seconds as printed, or the settling time"),
    ] = "second"
    move_weight: Annotated[
        float,
        Setting(
            "Weight w of the control-move penalty; 0 is none, as printed",
            otherwise=f"{MOVE_WEIGHT:g}",
            least=0.0,
        ),
    ] = 0.0
    criterion: Annotated[
        Literal["paper", "itae", "ise"],
        Setting("Criterion of the error: (35), ITAE or ISE", otherwise=_PRESET),
    ] = "paper"
    effort_weight: Annotated[
        float, Setting("Price rho of the effort", otherwise=_PRESET, least=0.0)
    ] = 0.0
    rejection: Annotated[
        float,
        Setting(
            "Share r of load rejection, which needs trials with a load step",
            otherwise=_PRESET,
            share=True,
            least=0.0,
            most=1.0,
        ),
    ] = 0.0
    function: Annotated[
        str, Setting("module:function of a cost of the response, which is then the whole cost")
    ] = ""
    unscaled: Annotated[bool, Field(exclude_if=lambda unscaled: not unscaled)] = False

    def __post_init__(self) -> None:
        check_settings(self)

    def evaluate(
        self,
        sampling_Hz: float,
        step: StepShape,
        setpoint: FloatArray,
        measurement: FloatArray,
        effort: FloatArray,
    ) -> float | FloatArray:
        """The cost eta of a sampled step response, or of a batch of them.

        Args:
            step: The step, whose size is dT, and the load.
            setpoint: Setpoint r before its filter, shape (samples,) or (..., samples).
            measurement: Measurement y, shape (..., samples).
            effort: Control effort u, shape (..., samples).

        Returns:
            A float, or an array of shape (...). NaN in the response gives NaN; a response too
            large to be squared gives infinity.

        Raises:
            InvalidInput: the settling time is longer than the record after the step, the step is
                zero or outside the record, the columns differ in length, or there is no sample
                before the step from which to count the first move.
        """
        step_index, step_size, load, ramp = step
        if not (math.isfinite(step_size) and step_size != 0.0):
            raise InvalidInput(f"step size is {step_size}; it must be finite and not zero")
        measurement = np.asarray(measurement)
        samples = measurement.shape[-1]
        if not 0 <= step_index < samples:
            raise InvalidInput(
                f"the step at sample {step_index} is outside the record of {samples} samples"
            )
        setpoint, effort = np.asarray(setpoint), np.asarray(effort)
        if not setpoint.shape[-1] == effort.shape[-1] == samples:
            raise InvalidInput(
                f"setpoint, measurement and effort have {setpoint.shape[-1]}, {samples} and "
                f"{effort.shape[-1]} samples; they must be of one length"
            )
        if self.rejection > 0.0 and load is None:
            raise InvalidInput(
                "the cost weighs load rejection, and the trial has no load step; give the step a "
                "load, or choose another cost"
            )
        if self.function:
            return self._by_function(sampling_Hz, step, (setpoint, measurement, effort))
        end = samples if load is None else load.sample
        # A diverged response overflows to infinity, which is its cost.
        with np.errstate(over="ignore", invalid="ignore"):
            error = setpoint - measurement
            eta = self._criterion(error[..., step_index:end] / step_size, sampling_Hz, ramp)
            if load is not None and self.rejection > 0.0:
                rejected = self._criterion(error[..., load.sample :] / load.size, sampling_Hz)
                eta = (1.0 - self.rejection) * eta + self.rejection * rejected
            if self.effort_weight > 0.0:
                used = _effort_used(effort[..., step_index:end] / step_size)
                eta = eta + self.effort_weight / (sampling_Hz * self.settling_time_s) * used
            if self.move_weight > 0.0:
                eta = eta + self.move_weight * _moves(step_index, step_size, effort)
        return float(eta) if np.ndim(eta) == 0 else np.asarray(eta)

    def _criterion(self, error: FloatArray, sampling_Hz: float, ramp: int = 1) -> FloatArray:
        """The criterion of an error relative to its step, shape (..., samples after it)."""
        weights = _normalised_weights(self, sampling_Hz, error.shape[-1], ramp)
        return np.asarray((np.abs(error) if self.criterion == "itae" else error**2) @ weights)

    def _by_function(
        self,
        sampling_Hz: float,
        step: StepShape,
        columns: tuple[FloatArray, FloatArray, FloatArray],
    ) -> float | FloatArray:
        """The cost by the user's function, of each response of a batch."""
        step_index, step_size, load, _ = step
        rest = [np.asarray(c)[..., : max(step_index, 1)].mean(-1, keepdims=True) for c in columns]
        rest[1] = rest[0]  # the error stays as it is
        moved = np.stack(np.broadcast_arrays(*(c - r for c, r in zip(columns, rest, strict=True))))
        *batch, samples = moved.shape[1:]
        time_s = (np.arange(samples) - step_index) / sampling_Hz
        costs = [
            evaluate_function(
                self.function,
                StepResponse(time_s, r, y, u, step_size, step_index, self.settling_time_s, load),
            )
            for r, y, u in np.moveaxis(moved.reshape(3, -1, samples), 1, 0)
        ]
        return np.reshape(costs, batch) if batch else costs[0]

    @property
    def is_quadratic(self) -> bool:
        """Whether `weights` and the move penalty are all of the cost."""
        return not self.function and self.criterion != "itae" and not self.effort_weight

    def scaled(self, gain: float | None) -> "StepCost":
        """The cost with the effort in units of the measurement: times the plant's gain.

        With it a weight means the same in all units. Without it the cost is `unscaled`.
        """
        if gain is None:
            return replace(self, unscaled=True)
        return replace(
            self,
            unscaled=False,
            move_weight=self.move_weight * gain**2,
            effort_weight=self.effort_weight * gain**2,
        )

    def weights(self, sampling_Hz: float, step: StepShape, samples: int) -> FloatArray:
        """Weights w_k, eta = sum(w_k eps_k^2)/dT^2, or of `|eps_k|/dT` for ITAE, from the step.

        Read-only, shape (samples - step.sample,). None is negative, so the cost of a running trial
        only grows. They do not contain the move penalty.

        Raises:
            InvalidInput: the settling time is longer than what remains of so many samples.
        """
        return _normalised_weights(self, sampling_Hz, samples - step.sample, step.ramp)


def default_cost(settling_time_s: float) -> StepCost:
    """The cost where none is chosen: (35) with the default control-move penalty."""
    return StepCost(settling_time_s, move_weight=MOVE_WEIGHT)


def cost_from(choice: str | CostFunction, settling_time_s: float) -> StepCost:
    """The cost of a name of `PRESETS`, of "module:function", or of a function.

    Raises:
        InvalidInput: there is no such cost.
    """
    if callable(choice):
        return StepCost(settling_time_s, function=reference_of(choice))
    if choice in PRESETS:
        return replace(default_cost(settling_time_s), **PRESETS[choice])
    if ":" not in choice:
        raise InvalidInput(
            f"there is no cost {choice!r}; give one of {', '.join(PRESETS)}, or module:function"
        )
    cost_function(choice)
    return StepCost(settling_time_s, function=choice)


def _effort_used(effort: FloatArray) -> FloatArray:
    """Sum of squared deviations from the mean of the last tenth of the samples."""
    away = effort - effort[..., -max(1, effort.shape[-1] // 10) :].mean(axis=-1, keepdims=True)
    return np.asarray(np.vecdot(away, away))


def _moves(step_index: int, step_size: float, effort: FloatArray) -> FloatArray:
    """sum((du_k/dT)^2) from the move made at the step itself on."""
    if step_index == 0:
        raise InvalidInput(
            "the step at the first sample has no effort before it to count the first move from; "
            "step later, or set the move weight to 0"
        )
    moves = np.diff(effort[..., step_index - 1 :]) / step_size
    return np.asarray(np.vecdot(moves, moves))


@lru_cache(maxsize=256)
def _normalised_weights(cost: StepCost, sampling_Hz: float, samples: int, ramp: int) -> FloatArray:
    """Weights of eps_k^2/dT^2 in N of (35) by quadrature, over N of the reference.

    The reference follows a setpoint that moves by 1/ramp in each of `ramp` samples.
    """
    check_positive("sampling rate", sampling_Hz, "Hz")
    if samples < 2:
        raise InvalidInput("the step is at the last sample; there is no response to score")
    t_s, h = cost.settling_time_s, 1.0 / sampling_Hz
    if t_s > samples * h * (1.0 + 1e-9):  # the margin is for rounding in samples * h
        raise InvalidInput(
            f"settling time {t_s:g} s is longer than the {samples * h:g} s recorded after the "
            "step; make the trial longer, step earlier, or choose a shorter settling time"
        )
    t = np.arange(samples, dtype=np.float64) * h
    sign = 1.0 if cost.weight == "printed" else -1.0
    exponent = sign * np.pi * (t - t_s) / (2.0 * t_s)
    # Past t_s the sigmoid is unused; the minimum prevents its overflow.
    sigmoid = 1.0 / (1.0 + np.exp(np.minimum(exponent, 700.0)))
    unit = 1.0 if cost.time_unit == "second" else t_s
    whole, reference = _trapezoid(t, h, t[-1]), np.exp(-4.0 * t / t_s)
    reference = np.convolve(reference, np.full(ramp, 1.0 / ramp))[:samples]
    weights: FloatArray
    if cost.criterion == "itae":
        weights = t * whole / (t * whole @ reference)
    elif cost.criterion == "ise":
        weights = whole / (whole @ reference**2)
    else:
        weights = t / unit**2 * whole + sigmoid / t_s * _trapezoid(t, h, t_s)
        weights /= weights @ reference**2
    weights.flags.writeable = False
    return weights


def _trapezoid(t: FloatArray, h: float, end: float) -> FloatArray:
    """Weights w_k such that w @ f integrates the straight lines through f from 0 to `end`, s.

    The end may lie between two samples, or beyond the last one.
    """
    left = np.clip((end - t[:-1]) / h, 0.0, 1.0)  # share of each interval inside
    weights = np.zeros_like(t)
    weights[:-1] += h * (left - left**2 / 2.0)
    weights[1:] += h * left**2 / 2.0
    return weights
