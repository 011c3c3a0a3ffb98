"""A sine whose frequency goes from one to another."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Excitation, Loop, check


@dataclass(frozen=True, slots=True)
class ChirpProfile(Excitation):
    """A sine whose frequency goes evenly from one to the other in the time after the start.

    With S = duration_s - start_s,

        setpoint = preload_N + amplitude_N sin(2 pi (first_Hz s + (last_Hz - first_Hz) s^2/(2 S))).

    Attributes:
        preload_N: Mean setpoint, N.
        amplitude_N: Amplitude, N; may be negative, not zero.
        first_Hz: Frequency at the start; zero or above.
        last_Hz: Frequency at the end; zero or above, below half the sampling rate.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    amplitude_N: float
    first_Hz: float
    last_Hz: float
    duration_s: float
    start_s: float = 0.0
    loop: Loop = "closed"
    kind: Literal["chirp"] = "chirp"

    def __post_init__(self) -> None:
        check(self, ("amplitude_N",), ())
        if not (min(self.first_Hz, self.last_Hz) >= 0.0 < max(self.first_Hz, self.last_Hz)):
            raise InvalidInput(
                f"chirp profile: {self.first_Hz:g} to {self.last_Hz:g} Hz; give frequencies of "
                "zero or above, not both zero"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint, N."""
        size = abs(self.amplitude_N)
        return self.preload_N - size, self.preload_N + size

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,).

        Raises:
            InvalidInput: a frequency is half the sampling rate or above.
        """
        highest_Hz = max(self.first_Hz, self.last_Hz)
        if not highest_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"chirp profile: it reaches {highest_Hz:g} Hz; it must stay below half the "
                f"sampling rate, {sampling_Hz / 2.0:g} Hz"
            )
        s = self._since_start(sampling_Hz)
        rate = (self.last_Hz - self.first_Hz) / (self.duration_s - self.start_s)  # Hz/s
        sine = np.sin(2.0 * np.pi * (self.first_Hz * s + 0.5 * rate * s**2))
        return np.where(s < 0.0, self.preload_N, self.preload_N + self.amplitude_N * sine)
