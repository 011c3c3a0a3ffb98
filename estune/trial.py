"""What is asked of a rig and what it answers: the request, the record, the rig itself."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.profiles import AnyProfile, Kind, Loop, Profile, StepProfile

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
    DECLINED = "declined"

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
    Outcome.DECLINED: "whoever was asked did not let the trial run",
}


@dataclass(frozen=True, slots=True)
class TrialRequest:
    """One trial to be run with the given gains.

    Attributes:
        run: Name of the run the trial belongs to.
        number: The trial's place in the run, from 0. A simulated rig's noise depends on it and
            on the rig's seed alone, so that a run can be repeated.
        gains: Controller gains for the duration of the trial.
        profile: The setpoint: a step for tuning, other profiles to find out about the rig. In an
            open loop the gains play no part.
        attempt: Counts repeats of a trial that was void, from 0. A trial id never runs twice.
    """

    run: str
    number: int
    gains: Gains
    profile: Profile
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
        preload_N: Tension held before the profile begins, N.
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
    loop: Loop = "closed"
    profile: Kind | Literal["custom"] = "step"


@dataclass(frozen=True, slots=True)
class LinearModel:
    """The plant at its operating point: `x' = A x + B v, y = C x + E v, v(t) = u(t - dead time)`.

    Attributes:
        A: State matrix as rows, shape (n, n), 1/s.
        B: Input vector, shape (n,).
        C: Output vector, shape (n,).
        E: Direct feed-through.
        dead_time_s: Delay of the input u, s.

    Raises:
        InvalidInput: a number is not finite.
    """

    A: tuple[tuple[float, ...], ...]
    B: tuple[float, ...]
    C: tuple[float, ...]
    E: float = 0.0
    dead_time_s: float = 0.0

    def __post_init__(self) -> None:
        numbers = (*(a for row in self.A for a in row), *self.B, *self.C, self.E, self.dead_time_s)
        if not all(map(math.isfinite, numbers)):
            raise InvalidInput("the linear model holds a number that is not finite")


@dataclass(frozen=True, slots=True)
class RigLimits:
    """What a rig will accept in a request.

    Attributes:
        tension_min_N: Least setpoint, N; of an open loop too.
        tension_max_N: Greatest setpoint, N; of an open loop too.
        duration_max_s: Longest trial, s.

    Raises:
        InvalidInput: the limits are the wrong way round, or none at all.
    """

    tension_min_N: float
    tension_max_N: float
    duration_max_s: float

    def __post_init__(self) -> None:
        # Both hold for infinite limits, and neither for NaN.
        if not (self.tension_min_N <= self.tension_max_N and self.duration_max_s > 0.0):
            raise InvalidInput(
                f"limits {self.tension_min_N:g} to {self.tension_max_N:g} N and "
                f"{self.duration_max_s:g} s: give them in order, and a duration above zero"
            )

    def check(self, profile: AnyProfile) -> None:
        """Refuses a profile the rig must not run.

        Raises:
            InvalidInput: a tension or the duration is outside the limits.
        """
        for tension in profile.extremes_N:
            if not self.tension_min_N <= tension <= self.tension_max_N:
                raise InvalidInput(
                    f"setpoint {tension:g} N is outside the rig's range "
                    f"{self.tension_min_N:g} to {self.tension_max_N:g} N; "
                    "choose another preload or a smaller change"
                )
        if profile.duration_s > self.duration_max_s:
            raise InvalidInput(
                f"a trial of {profile.duration_s:g} s is longer than the rig's limit of "
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
        simulated: Whether nothing physical moves, so that an interrupted trial may be asked for
            again without anybody having seen to the rig.

    Raises:
        InvalidInput: a number is not finite, or not above zero.
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
    simulated: bool = False

    def __post_init__(self) -> None:
        for name in ("newtons_per_ampere", "settling_time_s", "cable_length_m"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"rig {self.name}: {name} is {value}; it must be above zero")


def unmeasured(
    request: TrialRequest, rig: RigDescription, outcome: Outcome, reason: str, at: str
) -> TrialRecord:
    """The record of a trial that nothing was measured of: no samples, the live gains.

    Args:
        request: The trial.
        rig: The rig it was meant for.
        outcome: What came of it.
        reason: Why, in words.
        at: When, ISO 8601 with offset.
    """
    nothing = np.empty(0)
    return TrialRecord(
        trial_id=request.trial_id,
        rig=rig.name,
        sampling_Hz=rig.controller.sampling_Hz,
        cable_length_m=rig.cable_length_m,
        preload_N=request.profile.preload_N,
        gains=rig.gains,
        outcome=outcome,
        reason=reason,
        started_at=at,
        software=rig.software,
        time_s=nothing,
        setpoint_N=nothing,
        tension_N=nothing,
        current_A=nothing,
        angle_rad=nothing,
        flags=np.empty(0, np.uint8),
        loop=request.profile.loop,
        profile=request.profile.kind,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """Samples of a trial under way, for whoever looks on. Columns have shape (samples,).

    Attributes:
        trial_id: The trial.
        first: Index in the trial of the first sample here.
        sampling_Hz: Sampling rate.
        setpoint_N: The setpoint before its filter.
        tension_N: The measured tension.
        current_A: The motor current commanded.
        angle_rad: The drum angle measured.
    """

    trial_id: str
    first: int
    sampling_Hz: float
    setpoint_N: FloatArray
    tension_N: FloatArray
    current_A: FloatArray
    angle_rad: FloatArray


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

    def estop(self, reason: str) -> None:
        """Begins to bring the rig to its safe state, whatever it does, and returns at once.

        The trial under way, if any, ends. The rig stays there, and refuses trials and gains with a
        `RigError`, until it is cleared. May be called by any thread, any number of times.
        """
        ...

    def clear(self) -> None:
        """Ends an emergency stop: the rig may be used again. Nothing moves by it."""
        ...

    def close(self) -> None:
        """Lets go of the rig; further calls are refused."""
        ...


@runtime_checkable
class Watched(Protocol):
    """A rig that shows a trial while it runs."""

    def telemetry(self, after: int) -> Telemetry | None:
        """The samples of the trial under way from index `after` on; None if none is.

        They are a copy. May be called by any thread, often, and must not slow the trial.
        """
        ...
