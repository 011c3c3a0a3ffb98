"""What is asked of a rig and what it answers: the request, the record, the rig itself."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput

FloatArray = NDArray[np.float64]

SATURATED, GUARD, LATE = 1, 2, 4
"""Bits of the `flags` column: command limited, guard stepped in, sample late."""


class Outcome(StrEnum):
    """How a trial ended. Only `done` has a cost; the void ones say nothing about the gains."""

    DONE = "done"
    DIVERGED = "diverged"
    GUARD = "guard"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        return _SENTENCES[self]

    @property
    def is_void(self) -> bool:
        """Whether the trial says nothing about its gains, so that it may be asked for again."""
        return self in (Outcome.CANCELLED, Outcome.INTERRUPTED)


_SENTENCES = {
    Outcome.DONE: "the trial ran to its end",
    Outcome.DIVERGED: "the response left the finite range",
    Outcome.GUARD: "the rig's guard ended the trial at one of its limits",
    Outcome.CANCELLED: "the trial was stopped by the operator",
    Outcome.INTERRUPTED: "the rig stopped in the middle of the trial",
}


@dataclass(frozen=True, slots=True)
class StepProfile:
    """A step in the setpoint: hold the preload, and at `step_at_s` jump by the step.

    Attributes:
        preload_N: Tension held before the step, N.
        step_N: Size of the step, N; may be negative, not zero.
        step_at_s: Time of the step from the start of the trial, s; zero or above.
        duration_s: Length of the whole trial, s; after the step.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    step_N: float
    step_at_s: float
    duration_s: float

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

    def samples(self, sampling_Hz: float) -> int:
        """Number of samples in a trial."""
        return round(self.duration_s * sampling_Hz)

    def step_index(self, sampling_Hz: float) -> int:
        """Index of the first sample whose setpoint is the stepped one."""
        return round(self.step_at_s * sampling_Hz)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        setpoint = np.full(self.samples(sampling_Hz), float(self.preload_N + self.step_N))
        setpoint[: self.step_index(sampling_Hz)] = self.preload_N
        return setpoint


@dataclass(frozen=True, slots=True)
class TrialRequest:
    """One step trial to be run with the given gains.

    Attributes:
        run: Name of the run the trial belongs to.
        number: The trial's place in the run, from 0. A simulated rig's noise depends on it and
            on the rig's seed alone, so that a run can be repeated.
        gains: Controller gains for the duration of the trial.
        step: The setpoint to be followed.
        attempt: Counts repeats of a trial that was void, from 0. A trial id never runs twice.
    """

    run: str
    number: int
    gains: Gains
    step: StepProfile
    attempt: int = 0

    @property
    def trial_id(self) -> str:
        """Identifies the trial: on the rig, in the journal and in file names."""
        retry = f".{self.attempt}" if self.attempt else ""
        return f"{self.run}-{self.number:05d}{retry}"


@dataclass(frozen=True, slots=True, eq=False)
class TrialRecord:
    """What a rig measured in one trial. Columns have shape (samples,), fewer if it was cut short.

    Attributes:
        trial_id: The trial this is the record of.
        rig: Name of the rig.
        sampling_Hz: Sampling rate.
        cable_length_m: Deployed cable length, or None where there is no cable.
        preload_N: Tension held before the step, N.
        gains: The gains that were really applied.
        outcome: How the trial ended.
        reason: What happened, in words, where the outcome is not `done`.
        started_at: Wall-clock time of the start, ISO 8601 with offset.
        software: What ran the trial, name and version.
        time_s: Time from the start of the trial.
        setpoint_N: The setpoint before its filter.
        tension_N: The measured tension.
        current_A: The motor current commanded.
        angle_rad: The drum angle measured.
        flags: Bit field: see `SATURATED`, `GUARD`, `LATE`.
        reference_N: Tension measured outside the reel, where there is such a gauge.
        loop: `closed`, or `open` where the setpoint went straight to the current loop.
        profile: The kind of setpoint.
    """

    trial_id: str
    rig: str
    sampling_Hz: float
    cable_length_m: float | None
    preload_N: float
    gains: Gains
    outcome: Outcome
    reason: str
    started_at: str
    software: str
    time_s: FloatArray
    setpoint_N: FloatArray
    tension_N: FloatArray
    current_A: FloatArray
    angle_rad: FloatArray
    flags: NDArray[np.uint8]
    reference_N: FloatArray | None = None
    loop: Literal["closed", "open"] = "closed"
    profile: Literal["step", "triangle", "multisine", "chirp", "custom"] = "step"


@dataclass(frozen=True, slots=True)
class LinearModel:
    """The plant at its operating point: `x' = A x + B v, y = C x + E v, v(t) = u(t - dead time)`.

    Attributes:
        A: State matrix as rows, shape (n, n), 1/s.
        B: Input vector, shape (n,).
        C: Output vector, shape (n,).
        E: Direct feed-through.
        dead_time_s: Delay of the input u, s.
    """

    A: tuple[tuple[float, ...], ...]
    B: tuple[float, ...]
    C: tuple[float, ...]
    E: float = 0.0
    dead_time_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RigLimits:
    """What a rig will accept in a request.

    Attributes:
        tension_min_N: Least setpoint, N.
        tension_max_N: Greatest setpoint, N.
        duration_max_s: Longest trial, s.
    """

    tension_min_N: float
    tension_max_N: float
    duration_max_s: float

    def check(self, step: StepProfile) -> None:
        """Refuses a step the rig must not run.

        Raises:
            InvalidInput: a tension or the duration is outside the limits.
        """
        for tension in (step.preload_N, step.preload_N + step.step_N):
            if not self.tension_min_N <= tension <= self.tension_max_N:
                raise InvalidInput(
                    f"setpoint {tension:g} N is outside the rig's range "
                    f"{self.tension_min_N:g} to {self.tension_max_N:g} N; "
                    "choose another preload or step"
                )
        if step.duration_s > self.duration_max_s:
            raise InvalidInput(
                f"a trial of {step.duration_s:g} s is longer than the rig's limit of "
                f"{self.duration_max_s:g} s; choose a shorter one"
            )


@dataclass(frozen=True, slots=True)
class RigDescription:
    """What a rig says of itself.

    Attributes:
        name: Its name, unique on the link.
        gains: The gains that are live now; a trial puts them back when it ends.
        controller: The fixed part of its controller.
        newtons_per_ampere: Tension at rest per motor current, N/A: turns current into effort.
        limits: What it will accept.
        step: A step trial that suits it.
        settling_time_s: The settling time a good tuning of it can reach, s; t_s in (35).
        cable_length_m: Deployed cable length, m, or None.
        linear_model: The plant linearised about the suggested step, where it is known.
        software: What serves it, name and version.
    """

    name: str
    gains: Gains
    controller: ControllerSettings
    newtons_per_ampere: float
    limits: RigLimits
    step: StepProfile
    settling_time_s: float
    cable_length_m: float | None = None
    linear_model: LinearModel | None = None
    software: str = ""


class Rig(Protocol):
    """Anything that answers a trial request with a trial record.

    A trial is a guest: its gains are swapped in, and the live gains are back when `run` returns or
    raises. Failure of a trial is data, an outcome in the record; an exception means that the rig
    could not be asked.
    """

    def describe(self) -> RigDescription:
        """What the rig is, and which gains are live now."""
        ...

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: the rig cannot be reached, or knows another trial by that id.
        """
        ...

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones. The only way the live gains ever change."""
        ...

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        ...

    def close(self) -> None:
        """Lets go of the rig; further calls are refused."""
        ...
