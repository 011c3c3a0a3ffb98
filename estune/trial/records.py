"""Trial requests and trial records."""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.trial.description import RigDescription, omitted_if
from estune.trial.outcome import Outcome
from estune.trial.profiles import Kind, Loop, Profile

SATURATED, GUARD, LATE = 1, 2, 4
"""Bits of the `flags` column: command saturated, guard tripped, sample late."""


COLUMNS = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad")
"""Columns of every record, beside the flags."""

COMPENSATION_COLUMNS = (
    *("drum_velocity_rad_s", "gravity_N", "friction_A", "inertia_A"),
    *("angle_map_A", "notch_N", "eyelet_N", "current_limit_A"),
)
"""Columns of a rig's compensations; parts of the others, and not needed beside them."""

OPTIONAL_COLUMNS = ("reference_N", *COMPENSATION_COLUMNS)
"""Columns that only some rigs record."""


@dataclass(frozen=True, slots=True)
class TrialRequest:
    """One trial to be run with the given gains.

    Attributes:
        run: Name of the run the trial belongs to.
        number: Number of the trial in the run, from 0; it seeds a simulated rig's noise.
        gains: Gains for the trial; without effect in an open loop.
        profile: The setpoint.
        attempt: Number of void attempts before, from 0.
        compensation: Compensations for the trial: the table `[compensation]` of a rig's file as
            JSON, `{}` for none; empty keeps the rig's own.
    """

    run: str
    number: int
    gains: Gains
    profile: Profile
    attempt: int = 0
    compensation: Annotated[str, omitted_if("")] = ""

    @property
    def trial_id(self) -> str:
        """Id of the trial on the rig, in the journal and in file names."""
        retry = f".{self.attempt}" if self.attempt else ""
        return f"{self.run}-{self.number:05d}{retry}"


@dataclass(frozen=True, slots=True, eq=False)
class TrialRecord:
    """Record of one trial. Columns have shape (samples,), fewer if it ended early.

    Attributes:
        trial_id: Id of the trial.
        rig: Name of the rig.
        sampling_Hz: Sampling rate.
        cable_length_m: Deployed cable length, or None where there is no cable.
        preload_N: Tension held before the profile begins.
        gains: The applied gains.
        outcome: How the trial ended.
        reason: The outcome in words, unless it is `done`.
        started_at: Wall-clock time of the start, ISO 8601 with offset.
        software: Name and version of the rig's program.
        time_s: Time from the start of the trial.
        setpoint_N: The setpoint before its filter.
        tension_N: The measured tension.
        current_A: The motor current commanded.
        angle_rad: The drum angle measured.
        flags: Bit field: see `SATURATED`, `GUARD`, `LATE`.
        reference_N: Tension measured outside the reel, or None.
        loop: `closed`, or `open` if the setpoint went directly to the current loop.
        profile: The kind of setpoint.
        drum_velocity_rad_s: Velocity of the drum that the rig estimated, or None.
        gravity_N: The cable's weight that the rig took off the tension of its gauge, or None.
        friction_A: Part of the current that feeds friction forward, or None.
        inertia_A: Part of the current that feeds inertia forward, or None.
        angle_map_A: Part of the current that the map over the drum's angle gives, or None.
        notch_N: What the rig's notches took off the tension of its gauge, or None.
        eyelet_N: Friction of the eyelet that the rig took off the tension of its gauge, or None.
        current_limit_A: Greatest current of the drive that the anti-windup knew, zero for that of
            the rig, or None.
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
    drum_velocity_rad_s: FloatArray | None = None
    gravity_N: FloatArray | None = None
    friction_A: FloatArray | None = None
    inertia_A: FloatArray | None = None
    angle_map_A: FloatArray | None = None
    notch_N: FloatArray | None = None
    eyelet_N: FloatArray | None = None
    current_limit_A: FloatArray | None = None

    @property
    def optional_columns(self) -> dict[str, FloatArray]:
        """The columns of `OPTIONAL_COLUMNS` that the record has, in their order."""
        present = {name: getattr(self, name) for name in OPTIONAL_COLUMNS}
        return {name: column for name, column in present.items() if column is not None}

    @property
    def controller_A(self) -> FloatArray:
        """The current that the controller commanded, without what was fed forward."""
        fed = self.friction_A, self.inertia_A, self.angle_map_A
        forward = [column for column in fed if column is not None]
        return self.current_A - sum(forward) if forward else self.current_A

    @property
    def unfiltered(self) -> FloatArray:
        """The tension with what the rig's notches took off: by which a loop is judged."""
        return self.tension_N if self.notch_N is None else self.tension_N + self.notch_N

    @property
    def ended_late(self) -> bool:
        """Whether the rig's guard ended the trial because the loop's own sample came late."""
        return bool(self.flags.size) and int(self.flags[-1]) & (LATE | GUARD) == LATE | GUARD


def record_of(
    request: TrialRequest,
    rig: RigDescription,
    outcome: Outcome,
    reason: str,
    at: str,
    **columns: Any,
) -> TrialRecord:
    """The record of a trial with the requested gains; `at` is its time of day."""
    return TrialRecord(
        trial_id=request.trial_id,
        rig=rig.name,
        sampling_Hz=rig.controller.sampling_Hz,
        cable_length_m=rig.cable_length_m,
        preload_N=request.profile.preload_N,
        gains=request.gains,
        outcome=outcome,
        reason=reason,
        started_at=at,
        software=rig.software,
        loop=request.profile.loop,
        profile=request.profile.kind,
        **columns,
    )


def empty_record(
    request: TrialRequest, rig: RigDescription, outcome: Outcome, reason: str, at: str
) -> TrialRecord:
    """The record of a trial without samples, with the live gains; `at` is its time of day."""
    columns: dict[str, Any] = dict.fromkeys(COLUMNS, np.empty(0)) | {
        "flags": np.empty(0, np.uint8)
    }
    record = record_of(request, rig, outcome, reason, at, **columns)
    return replace(record, gains=rig.gains)


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """Samples of a running trial. Columns have shape (samples,).

    Attributes:
        trial_id: The trial.
        first_sample: Index in the trial of the first sample here.
        sampling_Hz: Sampling rate.
        setpoint_N: The setpoint before its filter.
        tension_N: The measured tension.
        current_A: The motor current commanded.
        angle_rad: The drum angle measured.
    """

    trial_id: str
    first_sample: int
    sampling_Hz: float
    setpoint_N: FloatArray
    tension_N: FloatArray
    current_A: FloatArray
    angle_rad: FloatArray
