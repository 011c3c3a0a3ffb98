"""The cost of a step response, (35).

With the error eps = r - y, the step dT and the time t measured from the step,

    eta = N(eps) / N(eps_1)                                                              (35)
    N(eps) = int t eps^2 dt + 1/t_s int_0^{t_s} eps^2 / (1 + exp(pi (t - t_s)/(2 t_s))) dt

Implements (35), where eps_1 = dT exp(-4 t/t_s) is the error of a first-order system that settles
within 2 % in the desired time t_s. Divided by it, eta depends on neither the size nor the sign of
the step, and eta = 1 reads "as good as first order". The paper advises t_s <= 2 pi / omega_n, with
omega_n the plant's natural frequency in rad/s.

Two things in the paper do not agree, and are options here:

* The printed sigmoid falls with time, from 0.83 at the step to 0.5 at t_s, so it weights the
  transient most; the prose says that the transient is de-emphasised. `weight="rising"` is the
  prose: the mirrored sigmoid, from 0.17 to 0.5.
* The printed terms have different units, s^2 N^2 and N^2, so that their balance changes with the
  unit of time. `time_unit="settling_time"` puts t in units of t_s, which makes eta the same for a
  fast and a slow loop of the same shape; "second" is as printed, with t in s.

The printed cost has no price on effort, and its optimum often lies at infinite gain. An optional
move penalty, `+ w sum((du_k/dT)^2)` over the samples from the step on, makes it interior. It is a
sum, not an integral, so w belongs to one sampling rate.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class StepCost:
    """The settings of (35).

    Attributes:
        settling_time_s: Desired settling time t_s, s; at most what is recorded after the step.
        weight: "printed", the sigmoid that falls with time, or "rising", the one of the prose.
        time_unit: "second" as printed, or "settling_time" for t in units of t_s.
        move_weight: Weight w of the move penalty, no unit; zero, the printed cost, has none.

    Raises:
        InvalidInput: a value is not finite, or not one of those it may be.
    """

    settling_time_s: float
    weight: Literal["printed", "rising"] = "printed"
    time_unit: Literal["second", "settling_time"] = "second"
    move_weight: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.settling_time_s) and self.settling_time_s > 0.0):
            raise InvalidInput(
                f"settling time is {self.settling_time_s} s; it must be finite and above zero"
            )
        if not (math.isfinite(self.move_weight) and self.move_weight >= 0.0):
            raise InvalidInput(
                f"move weight is {self.move_weight}; it must be finite, and zero or above"
            )
        if self.weight not in ("printed", "rising"):
            raise InvalidInput(f"weight is {self.weight!r}; it must be 'printed' or 'rising'")
        if self.time_unit not in ("second", "settling_time"):
            raise InvalidInput(
                f"time unit is {self.time_unit!r}; it must be 'second' or 'settling_time'"
            )

    def evaluate(  # noqa: PLR0917  the loop's own order: where the step is, then r, y, u
        self,
        sampling_Hz: float,
        step_index: int,
        step_N: float,
        setpoint_N: ArrayLike,
        measurement_N: ArrayLike,
        effort_N: ArrayLike,
    ) -> float | FloatArray:
        """The cost eta of a sampled step response, or of a batch of them.

        Args:
            sampling_Hz: Sampling rate.
            step_index: Index of the first sample whose setpoint is the stepped one.
            step_N: Size of the step dT, N; not zero.
            setpoint_N: Setpoint r before its filter, N, shape (samples,) or (..., samples).
            measurement_N: Measurement y, N, shape (..., samples).
            effort_N: Effort u, N, shape (..., samples); only the move penalty looks at it.

        Returns:
            A float, or an array of shape (...). NaN in the response gives NaN; a response too
            large to be squared gives infinity.

        Raises:
            InvalidInput: the settling time is longer than what was recorded after the step, the
                step is zero or outside the record, the columns differ in length, or there is no
                sample before the step to count the first move from.
        """
        if not (math.isfinite(step_N) and step_N != 0.0):
            raise InvalidInput(f"step size is {step_N} N; it must be finite and not zero")
        measurement = np.asarray(measurement_N)
        samples = measurement.shape[-1]
        if not 0 <= step_index < samples:
            raise InvalidInput(
                f"the step at sample {step_index} is outside the record of {samples} samples"
            )
        setpoint, effort = np.asarray(setpoint_N), np.asarray(effort_N)
        if not setpoint.shape[-1] == effort.shape[-1] == samples:
            raise InvalidInput(
                f"setpoint, measurement and effort have {setpoint.shape[-1]}, {samples} and "
                f"{effort.shape[-1]} samples; they must be of one length"
            )
        weights = _normalised_weights(self, sampling_Hz, samples - step_index)
        after = (..., slice(step_index, None))
        # A diverged response overflows to infinity, which says all there is to say.
        with np.errstate(over="ignore", invalid="ignore"):
            error = (setpoint[after] - measurement[after]) / step_N
            eta = (error * error) @ weights
            if self.move_weight > 0.0:
                eta = eta + self.move_weight * _moves(step_index, step_N, effort)
        return float(eta) if np.ndim(eta) == 0 else np.asarray(eta)

    def weights(self, sampling_Hz: float, samples: int) -> FloatArray:
        """Weights w_k with eta = sum(w_k eps_k^2)/dT^2 over the samples from the step on.

        None is below zero: what a trial has run up by a sample only grows. The move penalty is
        not in them.

        Args:
            sampling_Hz: Sampling rate.
            samples: How many there are from the step on.

        Returns:
            Read-only, shape (samples,).

        Raises:
            InvalidInput: the settling time is longer than so many samples.
        """
        return _normalised_weights(self, sampling_Hz, samples)


def _moves(step_index: int, step_N: float, effort: FloatArray) -> FloatArray:
    """sum((du_k/dT)^2) from the move made at the step itself on."""
    if step_index == 0:
        raise InvalidInput(
            "the step at the first sample has no effort before it to count the first move from; "
            "step later, or set the move weight to 0"
        )
    moves = np.diff(effort[..., step_index - 1 :]) / step_N
    return np.asarray(np.vecdot(moves, moves))


@lru_cache(maxsize=256)
def _normalised_weights(cost: StepCost, sampling_Hz: float, samples: int) -> FloatArray:
    """The quadrature of N in (35) as weights of eps_k^2/dT^2, over that of the reference."""
    if not (math.isfinite(sampling_Hz) and sampling_Hz > 0.0):
        raise InvalidInput(f"sampling rate is {sampling_Hz} Hz; it must be finite and above zero")
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
    # Past t_s the sigmoid is not used; only its overflow would be noticed.
    sigmoid = 1.0 / (1.0 + np.exp(np.minimum(exponent, 700.0)))
    unit = 1.0 if cost.time_unit == "second" else t_s
    weights: FloatArray = t / unit**2 * _trapezoid(t, h, t[-1]) + sigmoid / t_s * _trapezoid(
        t, h, t_s
    )
    weights /= weights @ np.exp(-4.0 * t / t_s) ** 2
    weights.flags.writeable = False
    return weights


def _trapezoid(t: FloatArray, h: float, end: float) -> FloatArray:
    """Weights w_k such that w @ f integrates the straight lines through f from 0 to `end`, s.

    The end may lie between two samples; past the last sample nothing is added.
    """
    left = np.clip((end - t[:-1]) / h, 0.0, 1.0)  # the share of each interval that is inside
    weights = np.zeros_like(t)
    weights[:-1] += h * (left - left**2 / 2.0)
    weights[1:] += h * left**2 / 2.0
    return weights
