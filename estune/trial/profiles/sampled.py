"""Common parts of profiles: length in samples, time from the start, range checks."""

import math
from dataclasses import fields
from typing import Any, Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

Loop = Literal["closed", "open"]

ROUNDING = 1e-9
"""Tolerance of times, relative to a sample or a stair, for rounding errors."""


class Sampled:
    """A profile with a length in samples."""

    __slots__ = ()
    duration_s: float

    def samples(self, sampling_Hz: float) -> int:
        """Number of samples in a trial."""
        return round(self.duration_s * sampling_Hz)


class Excitation(Sampled):
    """A profile that holds the preload, and from `start_s` on deviates from it by a formula."""

    __slots__ = ()
    preload_N: float
    start_s: float

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, shape (samples,).

        Raises:
            InvalidInput: its highest frequency is half the sampling rate or above.
        """
        s = np.arange(self.samples(sampling_Hz)) / sampling_Hz - self.start_s
        # The sample of the start itself, which rounding may put a little before it.
        s[np.abs(s) * sampling_Hz < ROUNDING * max(1.0, self.start_s * sampling_Hz)] = 0.0
        return np.where(s < 0.0, self.preload_N, self.preload_N + self._deviation(s, sampling_Hz))

    def _deviation(self, s: FloatArray, sampling_Hz: float) -> FloatArray:
        """Deviation from the preload at the times s after the start; those before do not count."""
        raise NotImplementedError


class SymmetricExcitation(Excitation):
    """An excitation between preload_N - |amplitude_N| and preload_N + |amplitude_N|."""

    __slots__ = ()
    amplitude_N: float

    @property
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest setpoint."""
        size = abs(self.amplitude_N)
        return self.preload_N - size, self.preload_N + size


def ordered(one: float, other: float) -> tuple[float, float]:
    """Both numbers, the smaller first."""
    return (one, other) if one <= other else (other, one)


def check(profile: Any, not_zero: tuple[str, ...], above_zero: tuple[str, ...]) -> None:
    """Refuses values that are not finite, zero, below zero, or times outside the trial.

    Raises:
        InvalidInput: a value is out of its range.
    """
    for field in fields(profile):
        value = getattr(profile, field.name)
        if isinstance(value, str):
            continue
        if not math.isfinite(value):
            raise InvalidInput(f"{profile.kind} profile: {field.name} is {value}; give a number")
        if (field.name in above_zero and value <= 0.0) or (field.name in not_zero and not value):
            wanted = "above zero" if field.name in above_zero else "other than zero"
            raise InvalidInput(
                f"{profile.kind} profile: {field.name} is {value}; it must be {wanted}"
            )
    start = getattr(profile, "start_s", 0.0)
    if not 0.0 <= start < profile.duration_s:
        raise InvalidInput(
            f"{profile.kind} profile: the start at {start} s must lie inside the trial of "
            f"{profile.duration_s} s"
        )
