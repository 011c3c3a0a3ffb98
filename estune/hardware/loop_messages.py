"""Messages between a rig and its real-time loop: the plan at the start, commands, and answers.

Plain values, so that the loop's process loads neither the rig's file nor what reads it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from estune.core.pidf import Coefficients
from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.hybrid_control import HybridPlan
from estune.hardware.live_gains import LengthSource
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.reel.guard import Limits
from estune.trial import Outcome


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the reel outside trials; see `[motion]` of the rig's file.

    Attributes:
        rate_N_s: Rate of the setpoint towards `hold_N` and towards a trial's preload, N/s.
        settle_N: Greatest distance from the preload during `settle_s`, N.
        settle_within_s: Time after which a trial is refused, s.
        take_up_N: Effort, open loop, with which a slack cable is taken up, N.
        taut_N: Tension at which the cable is taut and the loop is closed, N; minus infinity where
            there is nothing to take up.
    """

    hold_N: float
    rate_N_s: float
    settle_s: float
    settle_N: float
    settle_within_s: float
    take_up_N: float
    take_up_s: float
    taut_N: float


@dataclass(frozen=True, slots=True)
class SafeState:
    """State to which the guard brings the reel.

    Attributes:
        hold: Whether the live gains hold the reel after a trial's own gains failed, with sensors
            and clock in order. Otherwise the current is ramped.
        effort_N: Effort at the end of the ramp, N; at zero the amplifier is disabled.
        recover_s: Time in which the live gains must bring the reel back within its limits, s.
    """

    hold: bool
    effort_N: float
    ramp_s: float
    recover_s: float


@dataclass(frozen=True, slots=True)
class RealTime:
    """Timing of the loop.

    Attributes:
        priority: Real-time priority of its process, 1 to 99; zero requests none.
        lock_memory: Whether its memory is locked in main memory.
        spin_s: Time before each instant at which it stops sleeping and watches the clock, s.
        late_s: Time after its instant from which a sample counts as late, s.
    """

    priority: int
    lock_memory: bool
    cpu: int | None
    spin_s: float
    late_s: float


@dataclass(frozen=True, slots=True)
class BadReadings:
    """Bad readings up to which the reel stays in motion, on the values of the last good one.

    Attributes:
        travel_counts: Encoder counts of the greatest travel that the guard allows in a trial: a
            change of more between two readings is the encoder's, and no motion of the drum.
    """

    in_a_row: int
    seconds: float
    travel_counts: float


@dataclass(frozen=True, slots=True)
class LoopPlan:
    """Everything the loop needs.

    Attributes:
        driver: Name or module:attribute of the driver.
        capacity: Samples of the longest trial.
        gauge: C2.
        current: C1.
        radians_per_count: Turn of the drum per encoder count; its sign is the direction.
        newtons_per_ampere: Tension at rest per motor current, N/A.
        controller: C text of the controller.
        guard: Limits of the reel; each trial sets cost and duration.
    """

    driver: str
    driver_settings: dict[str, Any]
    sampling_Hz: float
    capacity: int
    gauge: GaugeScale
    current: CurrentScale
    radians_per_count: float
    newtons_per_ampere: float
    tension_min_N: float
    tension_max_N: float
    effort_min_N: float
    effort_max_N: float
    controller: str
    live: Coefficients
    length_source: LengthSource | None
    compensation: CompensationPlan | None
    compensation_source: str
    hybrid: HybridPlan | None
    guard: Limits
    bad_readings: BadReadings
    motion: Motion
    safe: SafeState
    timing: RealTime


class BeginTrial(NamedTuple):
    """Command: run a trial; setpoint and weights are in the shared memory.

    Attributes:
        open_loop: Whether the setpoint is the effort itself.
        cost_max: Running cost at which the guard stops it.
        duration_s: Longest time from its first sample, s.
        compensation: Compensations for this trial, and their C text; None keeps the rig's own.
    """

    number: int
    coefficients: Coefficients
    samples: int
    open_loop: bool
    cost_max: float
    duration_s: float
    compensation: tuple[CompensationPlan | None, str] | None = None


class SetLiveGains(NamedTuple):
    """Command: replace the live gains by fixed ones."""

    live: Coefficients


class SetCompensation(NamedTuple):
    """Command: replace the rig's own compensations, and their C text."""

    plan: CompensationPlan | None
    source: str


class ResetEstop(NamedTuple):
    """Command: let a rig that has stopped itself take trials again."""


class EndLoop(NamedTuple):
    """Command: bring the reel to rest and end."""


class Ready(NamedTuple):
    """Answer: the loop runs. `notes` are its requests to the system that were not granted."""

    notes: tuple[str, ...]


class Failed(NamedTuple):
    """Answer: the loop cannot run, or no longer: name of the error's class, and its message."""

    error: str
    sentence: str


class Refused(NamedTuple):
    """Answer: the trial has not begun, and will not."""

    reason: str


class Ended(NamedTuple):
    """Answer: a trial has ended, and the live gains are back.

    Attributes:
        reason: Why, where the outcome is not `done`.
        first_s: Time of its first sample on the monotonic clock, s; NaN without any.
    """

    number: int
    samples: int
    outcome: Outcome
    reason: str
    first_s: float


class Done(NamedTuple):
    """Answer: any other command has been executed."""
