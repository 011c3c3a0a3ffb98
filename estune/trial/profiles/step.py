"""A step in the setpoint."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Loop, Sampled, ordered


@dataclass(frozen=True, slots=True)
class StepProfile(Sampled):
    """A step in the setpoint: hold the preload, and at `step_at_s` jump by the step.

    setpoint = preload_N for k < round(step_at_s f_s), preload_N + step_N after that.

    Attributes:
        preload_N: Tension held before the step, N.
        step_N: Size of the step, N; may be negative, not zero.
        step_at_s: Time of the step from the start of the trial, s; zero or above.
        duration_s: Length of the whole trial, s; after the step.
        loop: Whether the controller follows the setpoint (`closed`), or it is the effort (`open`).
        kind: Kind of profile in messages.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    step_N: float
    step_at_s: float
    duration_s: float
    loop: Loop = "closed"
    kind: Literal["step"] = "step"

    def __post_init__(self) -> None:
        values = (self.preload_N, self.step_N, self.step_at_s, self.duration_s)
        if not all(map(math.isfinite, values)):  # ten times as fast as numpy on four floats
            raise InvalidInput(f"step profile {values} holds a value that is not finite")
        if self.step_N == 0.0:
            raise InvalidInput("the step is 0 N; without a step there is no response to score")
        if not 0.0 <= self.step_at_s < self.duration_s:
            raise InvalidInput(
                f"the step at {self.step_at_s} s must lie inside the trial of {self.duration_s} s"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Lowest and highest setpoint, N."""
        return ordered(self.preload_N, self.preload_N + self.step_N)

    def step_index(self, sampling_Hz: float) -> int:
        """Index of the first sample whose setpoint is the stepped one."""
        return round(self.step_at_s * sampling_Hz)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        setpoint = np.full(self.samples(sampling_Hz), float(self.preload_N + self.step_N))
        setpoint[: self.step_index(sampling_Hz)] = self.preload_N
        return setpoint
