"""Excitations for identification: triangle, chirp and staircase."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import (
    ROUNDING,
    Excitation,
    Loop,
    SymmetricExcitation,
    check,
    ordered,
)


@dataclass(frozen=True, slots=True)
class TriangleProfile(SymmetricExcitation):
    """A triangle about the preload: constant rates up and down, in cycles that may shrink.

    With the cycles passed p = s/period_s and c = floor(p),

        setpoint = preload_N + amplitude_N shrink^c (1 - |4 frac(p + 1/4) - 2|).

    It begins upward for a positive amplitude. A long period is a slow ramp through zero velocity;
    a shrink below one gives nested loops.

    Attributes:
        preload_N: Mean setpoint.
        amplitude_N: Amplitude of the first cycle; may be negative, not zero.
        period_s: Length of a cycle, s; above zero.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        shrink: Ratio of consecutive amplitudes; above zero, at most one.
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

    def _deviation(self, s: FloatArray, sampling_Hz: float) -> FloatArray:  # noqa: ARG002
        p = np.maximum(s, 0.0) / self.period_s
        triangle = 1.0 - np.abs(4.0 * np.mod(p + 0.25, 1.0) - 2.0)
        return self.amplitude_N * self.shrink ** np.floor(p) * triangle


@dataclass(frozen=True, slots=True)
class ChirpProfile(SymmetricExcitation):
    """A sine whose frequency changes linearly in the time after the start.

    With S = duration_s - start_s,

        setpoint = preload_N + amplitude_N sin(2 pi (first_Hz s + (last_Hz - first_Hz) s^2/(2 S))).

    Attributes:
        preload_N: Mean setpoint.
        amplitude_N: Amplitude; may be negative, not zero.
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

    def _deviation(self, s: FloatArray, sampling_Hz: float) -> FloatArray:
        highest_Hz = max(self.first_Hz, self.last_Hz)
        if not highest_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"chirp profile: it reaches {highest_Hz:g} Hz; it must stay below half the "
                f"sampling rate, {sampling_Hz / 2.0:g} Hz"
            )
        rate = (self.last_Hz - self.first_Hz) / (self.duration_s - self.start_s)  # Hz/s
        sine = np.sin(2.0 * np.pi * (self.first_Hz * s + 0.5 * rate * s**2))
        return np.asarray(self.amplitude_N * sine)


@dataclass(frozen=True, slots=True)
class StaircaseProfile(Excitation):
    """Stairs up and down again: steps of one size at several tensions.

    With the stairs passed j = floor(s/hold_s), and c = (j + 1) mod (2 stairs),

        setpoint = preload_N + step_N min(c, 2 stairs - c).

    One stair is a repeated step and return; a long hold shows creep and drift.

    Attributes:
        preload_N: The lowest level; the highest where the step is negative.
        step_N: Height of a stair; may be negative, not zero.
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
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest setpoint of a whole staircase."""
        return ordered(self.preload_N, self.preload_N + self.stairs * self.step_N)

    def _deviation(self, s: FloatArray, sampling_Hz: float) -> FloatArray:  # noqa: ARG002
        c = np.mod(np.floor(s / self.hold_s + ROUNDING) + 1.0, 2.0 * self.stairs)
        return np.asarray(self.step_N * np.minimum(c, 2.0 * self.stairs - c))
