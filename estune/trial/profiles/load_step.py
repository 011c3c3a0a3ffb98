"""A step in the setpoint, followed by a step of the load at the plant's input."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.core.response import LoadStep
from estune.errors import InvalidInput
from estune.trial.profiles.step import StepProfile


@dataclass(frozen=True, slots=True)
class LoadStepProfile(StepProfile):
    """A step in the setpoint, and after it a load that the rig adds to the effort.

    setpoint as of `StepProfile`; load = 0 for k < round(load_at_s f_s), load_N after that. The
    recorded current is that of the controller, without the load.

    Attributes:
        preload_N: As in `StepProfile`.
        step_N: As in `StepProfile`.
        step_at_s: As in `StepProfile`.
        duration_s: As in `StepProfile`.
        loop: As in `StepProfile`.
        load_N: The load, N; may be negative, not zero.
        load_at_s: Time from the start of the trial at which it begins, s; after the step.
        kind: Kind of profile in messages.

    Raises:
        InvalidInput: a value is out of its range.
    """

    load_N: float = 0.0
    load_at_s: float = 0.0
    if not TYPE_CHECKING:  # a narrower literal than its base has
        kind: Literal["load_step"] = "load_step"

    def __post_init__(self) -> None:
        StepProfile.__post_init__(self)
        if not (math.isfinite(self.load_N) and self.load_N != 0.0):
            raise InvalidInput(f"the load is {self.load_N} N; it must be finite and not zero")
        if not self.step_at_s < self.load_at_s < self.duration_s:
            raise InvalidInput(
                f"the load at {self.load_at_s:g} s must come after the step at "
                f"{self.step_at_s:g} s and before the end at {self.duration_s:g} s"
            )

    def load_step(self, sampling_Hz: float) -> LoadStep:
        """First sample and size of the load."""
        return LoadStep(round(self.load_at_s * sampling_Hz), self.load_N)

    def load(self, sampling_Hz: float) -> FloatArray:
        """The load at each sample, N."""
        load = np.zeros(self.samples(sampling_Hz))
        load[self.load_step(sampling_Hz).sample :] = self.load_N
        return load
