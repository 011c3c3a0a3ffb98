"""The cost of a step response, (35).

With the error eps = r - y, the step dT and the time t measured from the step,

    eta = N(eps) / N(eps_1)                                                              (35)
    N(eps) = int t eps^2 dt + 1/t_s int_0^{t_s} eps^2 / (1 + exp(pi (t - t_s)/(2 t_s))) dt

Implements (35), where eps_1 = dT exp(-4 t/t_s) is the error of a first-order system that settles
within 2 % in the desired time t_s. So eta depends on neither the size nor the sign of the step,
and eta = 1 means "as good as first order". The paper advises t_s <= 2 pi / omega_n, with omega_n
the plant's natural frequency in rad/s.

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
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput

MOVE_WEIGHT = 0.2
"""Default control-move penalty: without it, (35) has no interior optimum on a good plant."""


@dataclass(frozen=True, slots=True)
class StepCost:
    """The settings of (35).

    Attributes:
        settling_time_s: Desired settling time t_s, s; at most the time recorded after the step.
        weight: "printed", the sigmoid that falls with time, or "rising", that of the prose.
        time_unit: "second" as printed, or "settling_time" for t in units of t_s.
        move_weight: Weight w of the control-move penalty, no unit; zero as printed.

    Raises:
        InvalidInput: a value is out of its range or not among the choices.
    """

    settling_time_s: float
    weight: Literal["printed", "rising"] = "printed"
    time_unit: Literal["second", "settling_time"] = "second"
    move_weight: float = 0.0

    def __post_init__(self) -> None:
        check_positive("settling time", self.settling_time_s, "s")
        check_not_negative("move weight", self.move_weight)
        if self.weight not in ("printed", "rising"):
            raise InvalidInput(f"weight is {self.weight!r}; it must be 'printed' or 'rising'")
        if self.time_unit not in ("second", "settling_time"):
            raise InvalidInput(
                f"time unit is {self.time_unit!r}; it must be 'second' or 'settling_time'"
            )

    def evaluate(  # noqa: PLR0917  the order of the loop: the step, then r, y, u
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
            step_index: Index of the first sample of the stepped setpoint.
            step_N: Size of the step dT, N; not zero.
            setpoint_N: Setpoint r before its filter, N, shape (samples,) or (..., samples).
            measurement_N: Measurement y, N, shape (..., samples).
            effort_N: Control effort u, N, shape (..., samples); for the move penalty only.

        Returns:
            A float, or an array of shape (...). NaN in the response gives NaN; a response too
            large to be squared gives infinity.

        Raises:
            InvalidInput: the settling time is longer than the record after the step, the step is
                zero or outside the record, the columns differ in length, or there is no sample
                before the step from which to count the first move.
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
        # A diverged response overflows to infinity, which is its cost.
        with np.errstate(over="ignore", invalid="ignore"):
            error = (setpoint[after] - measurement[after]) / step_N
            eta = (error * error) @ weights
            if self.move_weight > 0.0:
                eta = eta + self.move_weight * _moves(step_index, step_N, effort)
        return float(eta) if np.ndim(eta) == 0 else np.asarray(eta)

    def weights(self, sampling_Hz: float, samples: int) -> FloatArray:
        """Weights w_k with eta = sum(w_k eps_k^2)/dT^2 over the samples from the step on.

        Read-only, shape (samples,). None is negative, so the cost of a running trial only grows.
        They do not contain the move penalty.

        Raises:
            InvalidInput: the settling time is longer than so many samples.
        """
        return _normalised_weights(self, sampling_Hz, samples)


def default_cost(settling_time_s: float) -> StepCost:
    """The cost where none is chosen: (35) with the default control-move penalty."""
    return StepCost(settling_time_s, move_weight=MOVE_WEIGHT)


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
    """Weights of eps_k^2/dT^2 in N of (35) by quadrature, over N of the reference."""
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
    weights: FloatArray = t / unit**2 * _trapezoid(t, h, t[-1]) + sigmoid / t_s * _trapezoid(
        t, h, t_s
    )
    weights /= weights @ np.exp(-4.0 * t / t_s) ** 2
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
