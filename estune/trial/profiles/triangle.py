"""A triangle: the same way at an even rate, up and down."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Excitation, Loop, check


@dataclass(frozen=True, slots=True)
class TriangleProfile(Excitation):
    """A triangle about the preload: constant rates up and down, in cycles that may shrink.

    With the cycles passed p = s/period_s and c = floor(p),

        setpoint = preload_N + amplitude_N shrink^c (1 - |4 frac(p + 1/4) - 2|).

    It begins upward for a positive amplitude. A long period is a slow ramp through zero velocity,
    a shrink below one gives ever smaller loops inside each other.

    Attributes:
        preload_N: Mean setpoint, N.
        amplitude_N: Of the first cycle, N; may be negative, not zero.
        period_s: Length of a cycle, s; above zero.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        shrink: What a cycle's amplitude is of that before it; above zero, at most one.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    amplitude_N: float
    period_s: float
    duration_s: float
    start_s: float = 0.0
    shrink: float = 1.0
    loop: Loop = "closed"
    kind: Literal["triangle"] = "triangle"

    def __post_init__(self) -> None:
        check(self, ("amplitude_N",), ("period_s",))
        if not 0.0 < self.shrink <= 1.0:
            raise InvalidInput(
                f"triangle profile: shrink is {self.shrink}; it must be above zero, at most 1"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint, N; those of the first cycle."""
        size = abs(self.amplitude_N)
        return self.preload_N - size, self.preload_N + size

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        s = self._since_start(sampling_Hz)
        p = np.maximum(s, 0.0) / self.period_s
        triangle = 1.0 - np.abs(4.0 * np.mod(p + 0.25, 1.0) - 2.0)
        amplitude = self.amplitude_N * self.shrink ** np.floor(p)
        return np.where(s < 0.0, self.preload_N, self.preload_N + amplitude * triangle)
