"""What a rig tells its real-time loop: the plan it starts with, commands, and the answers.

Plain values, so that the loop's process needs neither the rig's file nor what reads it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from estune.core.pidf import Coefficients
from estune.hardware.live_gains import LengthSource
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.reel.guard import Limits
from estune.trial import Outcome


@dataclass(frozen=True, slots=True)
class Motion:
    """How the reel is moved outside trials.

    Attributes:
        hold_N: Tension held between trials, N.
        rate_N_s: How fast the setpoint moves to it and to a trial's preload, N/s.
        settle_s: How long the preload is held before a trial begins, s.
        settle_N: How near the tension must stay to it meanwhile, N.
        settle_within_s: How long that may take before the trial is refused, s.
        take_up_N: Effort, open loop, with which a slack cable is taken up, N.
        take_up_s: How long that may take, s.
        taut_N: Tension at which the cable is taut and the loop is closed, N.
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
    """Where the guard brings the reel.

    Attributes:
        hold: Whether the reel is held by the live gains where a trial's own gains were stopped
            and sensors and clock are sound. Else, and from everywhere else, the current is ramped.
        effort_N: Effort at the end of the ramp, N; at zero the amplifier is disabled.
        ramp_s: Length of the ramp, s.
        recover_s: How long the live gains have to bring the reel back within its limits, s.
    """

    hold: bool
    effort_N: float
    ramp_s: float
    recover_s: float


@dataclass(frozen=True, slots=True)
class RealTime:
    """How the loop keeps its time.

    Attributes:
        priority: Real-time priority of its process, 1 to 99; zero asks for none.
        lock_memory: Whether its memory is to stay in main memory.
        cpu: The core it is bound to; None for any.
        spin_s: How long before each instant it stops sleeping and watches the clock, s.
        late_s: How long after its instant a sample counts as late, s.
    """

    priority: int
    lock_memory: bool
    cpu: int | None
    spin_s: float
    late_s: float


@dataclass(frozen=True, slots=True)
class LoopPlan:
    """Everything the loop needs.

    Attributes:
        driver: Name or module:attribute of the driver.
        driver_settings: What it is called with.
        sampling_Hz: Sampling rate.
        capacity: Samples of the longest trial.
        gauge: C2.
        current: C1.
        radians_per_count: Turn of the drum per encoder count; its sign is the direction.
        newtons_per_ampere: Tension at rest per motor current, N/A.
        tension_min_N: Least setpoint, N.
        tension_max_N: Greatest setpoint, N.
        effort_min_N: Least effort, N.
        effort_max_N: Greatest effort, N.
        controller: C text of the controller.
        live: The live gains' difference equation, at the start.
        following: How they follow the cable's length; None where they are fixed.
        guard: What the reel may do; cost and duration are set by each trial.
        motion: How the reel is moved outside trials.
        safe: Where the guard brings it.
        timing: How the loop keeps its time.
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
    following: LengthSource | None
    guard: Limits
    motion: Motion
    safe: SafeState
    timing: RealTime


class Begin(NamedTuple):
    """Asks for a trial; setpoint and weights are in the shared memory.

    Attributes:
        number: Tells this trial from others; above zero, never used twice.
        coefficients: The trial's gains.
        samples: Its length.
        open_loop: Whether the setpoint is the effort itself.
        cost_max: What it may run up.
        duration_s: How long it may take from its first sample, s.
    """

    number: int
    coefficients: Coefficients
    samples: int
    open_loop: bool
    cost_max: float
    duration_s: float


class SetLiveGains(NamedTuple):
    """Asks for other live gains, fixed ones."""

    live: Coefficients


class SetLength(NamedTuple):
    """Says how long the cable is now, m."""

    length_m: float


class ResetEstop(NamedTuple):
    """Asks that a rig which has stopped itself takes trials again."""


class End(NamedTuple):
    """Asks the loop to bring the reel to rest and end."""


class Ready(NamedTuple):
    """The loop runs. `notes` say what it asked for and did not get."""

    notes: tuple[str, ...]


class Failed(NamedTuple):
    """The loop cannot run, or no longer: the kind of error by name, and its message."""

    error: str
    sentence: str


class Refused(NamedTuple):
    """A trial has not begun, and will not."""

    sentence: str


class Ended(NamedTuple):
    """A trial has ended, and the live gains are back.

    Attributes:
        number: Which.
        kept: How many samples of it there are.
        outcome: How.
        sentence: Why, where it is not `done`.
        first_s: When its first sample was read, on the monotonic clock, s; NaN without any.
    """

    number: int
    kept: int
    outcome: Outcome
    sentence: str
    first_s: float


class Done(NamedTuple):
    """Any other command has been carried out."""
