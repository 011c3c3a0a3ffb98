"""Stairs up and down again."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import ROUNDING, Excitation, Loop, check, ordered


@dataclass(frozen=True, slots=True)
class StaircaseProfile(Excitation):
    """Stairs up and down again, each held: steps of one size at several tensions.

    With the stairs passed j = floor(s/hold_s), and c = (j + 1) mod (2 stairs),

        setpoint = preload_N + step_N min(c, 2 stairs - c).

    One stair is a step and its return, repeated; a long hold shows what creeps and drifts.

    Attributes:
        preload_N: The lowest level, N; the highest where the step is negative.
        step_N: Height of a stair, N; may be negative, not zero.
        stairs: Stairs from the preload to the farthest level, from 1.
        hold_s: Time on each level, s; above zero.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    step_N: float
    stairs: int
    hold_s: float
    duration_s: float
    start_s: float = 0.0
    loop: Loop = "closed"
    kind: Literal["staircase"] = "staircase"

    def __post_init__(self) -> None:
        check(self, ("step_N",), ("hold_s",))
        if self.stairs < 1:
            raise InvalidInput(f"staircase profile: {self.stairs} stairs; give 1 or more")

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint of a whole staircase, N."""
        return ordered(self.preload_N, self.preload_N + self.stairs * self.step_N)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        s = self._since_start(sampling_Hz)
        c = np.mod(np.floor(s / self.hold_s + ROUNDING) + 1.0, 2.0 * self.stairs)
        level = np.minimum(c, 2.0 * self.stairs - c)
        return np.where(s < 0.0, self.preload_N, self.preload_N + self.step_N * level)
