"""Protocol of a simulated plant, and the columns of its trials."""

import math
from functools import lru_cache
from importlib.metadata import version
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import RigDescription
from estune.trial.profiles import AnyProfile, LoadStepProfile, StepProfile
from plants.simulation.compensation import TrialCompensation

SOFTWARE = f"estune {version('estune')}"


class TrialSetpoint(NamedTuple):
    """What a trial asks of the plant at each of its samples."""

    time_s: FloatArray  # time at each sample, shape (samples,)
    setpoint_N: FloatArray  # the setpoint, same shape
    preload_N: float  # the tension at which the trial starts settled
    open_loop: bool  # whether the setpoint is the effort, limited by the controller's limits
    load_N: FloatArray | None = None  # added to the effort on its way to the plant, same shape
    compensation: TrialCompensation | None = None  # beside the controller


@lru_cache(maxsize=16)
def drive_of(profile: AnyProfile, sampling_Hz: float) -> TrialSetpoint:
    """The drive of a profile at a sampling rate; shared and read-only.

    Raises:
        InvalidInput: the trial has no sample after its start or its step, or the profile exceeds
            half the rate.
    """
    samples = profile.samples(sampling_Hz)
    first = profile.step_index(sampling_Hz) if isinstance(profile, StepProfile) else 0
    if not first < samples:
        raise InvalidInput(
            f"a {profile.kind} trial of {profile.duration_s:g} s has no sample after its start at "
            f"{sampling_Hz:g} Hz; make it longer"
        )
    time, setpoint = np.arange(samples) / sampling_Hz, profile.setpoint(sampling_Hz)
    time.flags.writeable = setpoint.flags.writeable = False
    load = None
    if isinstance(profile, LoadStepProfile):
        load = profile.shape(sampling_Hz).loads(samples)
    return TrialSetpoint(time, setpoint, profile.preload_N, profile.loop == "open", load)


class Columns(NamedTuple):
    """Columns of a batch of trials; samples from `ended` on are undefined."""

    tension_N: FloatArray  # measured tension, shape (trials, samples)
    effort_N: FloatArray  # effort of the motor, same shape
    angle_rad: FloatArray  # measured drum angle, same shape; zero where the plant has no drum
    flags: NDArray[np.uint8]  # `SATURATED` where the controller's limits acted, same shape
    # First sample of each trial outside the bound or not finite, or the number of samples, shape
    # (trials,).
    ended: NDArray[np.int64]
    # Tension outside the reel, same shape; None where it is the same.
    reference_N: FloatArray | None = None
    # Compensations in the order of `CompensationTerms`, shape (trials, samples, terms); None where
    # there are none. The measured tension is that of the gauge, with all of it.
    terms: FloatArray | None = None

    @classmethod
    def empty(cls, trials: int, samples: int, *, reference: bool = False) -> "Columns":
        """Empty columns for a batch of trials, with or without the tension outside."""
        signals = np.empty((3, trials, samples))
        flags, ended = np.zeros((trials, samples), np.uint8), np.empty(trials, np.int64)
        outside = np.empty((trials, samples)) if reference else None
        return cls(signals[0], signals[1], signals[2], flags, ended, outside)

    def trial(self, n: int) -> "Columns":
        """Views of the columns of one trial."""
        signals = self.tension_N[n], self.effort_N[n], self.angle_rad[n]
        outside = None if self.reference_N is None else self.reference_N[n]
        terms = None if self.terms is None else self.terms[n]
        return Columns(*signals, self.flags[n], self.ended[n : n + 1], outside, terms)


class Plant(Protocol):
    """A plant whose trials can be simulated."""

    @property
    def controller(self) -> ControllerSettings:
        """The fixed part of the controller."""

    @property
    def profile(self) -> StepProfile:
        """A step trial that suits the plant."""

    @property
    def noise_rms_N(self) -> float:
        """Root mean square of the measurement noise, N."""

    @property
    def newtons_per_ampere(self) -> float:
        """Effort per motor current, N/A."""

    def respond(
        self,
        coefficients: FloatArray,
        drive: TrialSetpoint,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of trials, one after the other.

        Args:
            coefficients: The controllers' difference equations, one row each in the order of
                `estune.core.pidf.Coefficients`, shape (trials, 9).
            drive: Setpoint and mode.
            noise_N: Measurement noise, shape (trials, samples), or None.
            bound_N: Magnitude of the measurement at which a trial ends.

        Raises:
            PlantError: the plant cannot be simulated.
        """

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        """Description of a rig that runs this plant, with given or safe gains.

        Raises:
            UnsafeStart: no gains were given and no safe ones are known.
        """


def split_dead_time(dead_time_s: float, sampling_Hz: float) -> tuple[int, float]:
    """A dead time as whole samples and the remaining fraction of one, to within rounding."""
    samples = dead_time_s * sampling_Hz
    whole = round(samples)
    if abs(samples - whole) <= 1e-9 * max(1.0, samples):
        return whole, 0.0
    return math.floor(samples), samples - math.floor(samples)
