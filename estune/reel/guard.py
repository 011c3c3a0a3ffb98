"""Guard of the control loop: the paper's process for run-time errors (section IV).

It checks every sample before the controller runs and decides, in the same sample, whether the reel
must go to its safe state, and why. It is pure: its state is a value, and time comes with the
samples.

There are two kinds of reasons. A limit violated by the reel itself (tension, slack, rate, current,
angle, cost) is caused by the live gains. A fault around it (sensor, clock, supervisor of the loop)
is no information on the gains.
"""

import math
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import NamedTuple

from estune.errors import InvalidInput
from estune.support.quantity_text import with_unit


class Reason(StrEnum):
    """Reason for which the guard stops a reel."""

    TENSION = "tension"
    SLACK = "slack"
    RATE = "rate"
    CURRENT = "current"
    ANGLE = "angle"
    TRAVEL = "travel"
    COST = "cost"
    READING = "reading"
    FROZEN = "frozen"
    CLOCK = "clock"
    LATE = "late"
    DEADLINE = "deadline"
    HEARTBEAT = "heartbeat"

    @property
    def is_caused_by_gains(self) -> bool:
        """Whether the live gains are the cause."""
        return self in _BY_GAINS

    @property
    def leaves_control(self) -> bool:
        """Whether closed-loop control is still possible: sensors and clock work."""
        return self in _BY_GAINS or self in (Reason.HEARTBEAT, Reason.DEADLINE)


_BY_GAINS = frozenset(
    (
        *(Reason.TENSION, Reason.SLACK, Reason.RATE, Reason.CURRENT),
        *(Reason.ANGLE, Reason.TRAVEL, Reason.COST),
    )
)


class GuardWords(NamedTuple):
    """What the guard's sentences call the signals, with their units; of a reel by default.

    Attributes:
        measured: What the gauge measures.
        current: What is commanded to the amplifier.
    """

    measured: str = "tension"
    measured_unit: str = "N"
    current: str = "current"
    current_unit: str = "A"


REEL_WORDS = GuardWords()


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of a reel; an infinite one does not apply.

    Attributes:
        tension_max_N: Greatest tension, N.
        slack_N: Tension below which the cable counts as slack, N.
        slack_s: Longest time slack, s, once the cable has been taut.
        rate_max_N_s: Greatest rate of the tension between two samples, either way, N/s.
        current_max_A: Greatest magnitude of the continuous current, A.
        current_s: Longest time above it, s.
        angle_min_rad: Least drum angle, rad.
        angle_max_rad: Greatest drum angle, rad.
        travel_max_rad: Greatest rotation of the drum since the first sample, either way, rad.
        frozen_s: Longest time of constant gauge counts, s.
        gap_s: Longest time from one sample to the next, s.
        late_in_a_row: Greatest number of late samples in a row.
        heartbeat_s: Longest silence of the supervisor of the loop, s.
        cost_max: Greatest cost of the trial so far.
        duration_s: Longest time since the first sample, s.
        words: Names and units in the sentences.

    Raises:
        InvalidInput: a value is out of its range, or two are the wrong way round.
    """

    tension_max_N: float = math.inf
    slack_N: float = -math.inf
    slack_s: float = 0.0
    rate_max_N_s: float = math.inf
    current_max_A: float = math.inf
    current_s: float = 0.0
    angle_min_rad: float = -math.inf
    angle_max_rad: float = math.inf
    travel_max_rad: float = math.inf
    frozen_s: float = math.inf
    gap_s: float = math.inf
    late_in_a_row: float = math.inf
    heartbeat_s: float = math.inf
    cost_max: float = math.inf
    duration_s: float = math.inf
    words: GuardWords = REEL_WORDS

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is self.words:
                continue
            # Every comparison with it is false: the limit would never trip, and nobody would know.
            if math.isnan(value):
                raise InvalidInput(f"guard limit {field.name} is not a number")
            if field.name.endswith(("_s", "_A", "_row", "travel_max_rad")) and value < 0.0:
                raise InvalidInput(
                    f"guard limit {field.name} is {value:g}; it must be zero or above"
                )
        for low, high in (("slack_N", "tension_max_N"), ("angle_min_rad", "angle_max_rad")):
            if not getattr(self, low) < getattr(self, high):
                raise InvalidInput(
                    f"guard limits {low} {getattr(self, low):g} and {high} "
                    f"{getattr(self, high):g} are not in order"
                )


class Sample(NamedTuple):
    """Input of the guard at one sample.

    Attributes:
        tension_N: Tension, N; NaN if the reading is outside the calibration.
        current_A: Current commanded at the last sample, A.
        late: Whether the sample was late.
        silence_s: Time since the last heartbeat of the supervisor, s.
        cost: Cost of the trial so far, this sample included.
        held: Whether the values are those of an earlier reading, in place of a bad one.
    """

    time_s: float
    tension_N: float
    gauge_counts: float
    current_A: float
    angle_rad: float
    late: bool = False
    silence_s: float = 0.0
    cost: float = 0.0
    held: bool = False


class GuardState(NamedTuple):
    """The state of the guard between samples."""

    start_s: float
    start_rad: float
    time_s: float
    tension_N: float
    gauge_counts: float
    changed_s: float  # time of the last change of the counts
    taut_s: float  # last time the cable was taut; infinite before
    within_s: float  # last time the current was within its limit
    late_in_a_row: int


class GuardTrip(NamedTuple):
    """Decision of the guard that the reel must go to its safe state."""

    reason: Reason
    sentence: str


def begin(sample: Sample) -> GuardState:
    """The state before the first sample is checked."""
    return GuardState(
        start_s=sample.time_s,
        start_rad=sample.angle_rad,
        time_s=-math.inf,
        tension_N=math.nan,
        gauge_counts=math.nan,
        changed_s=sample.time_s,
        taut_s=math.inf,
        within_s=sample.time_s,
        late_in_a_row=0,
    )


def check_sample(
    limits: Limits, watch: GuardState, sample: Sample
) -> tuple[GuardState, GuardTrip | None]:
    """One sample of the guard.

    Args:
        watch: State after the last sample; `begin` at the first.

    Returns:
        The next state, and the trip, if any. Of several violations at once the most severe is
        named: first those that make the others meaningless.
    """
    now, tension = sample.time_s, sample.tension_N
    following = GuardState(
        start_s=watch.start_s,
        start_rad=watch.start_rad,
        time_s=now,
        tension_N=tension,
        gauge_counts=sample.gauge_counts,
        changed_s=_changed_s(watch, sample),
        # A cable that was never taut does not count as slack.
        taut_s=now if tension >= limits.slack_N else watch.taut_s,
        within_s=now if abs(sample.current_A) <= limits.current_max_A else watch.within_s,
        late_in_a_row=watch.late_in_a_row + 1 if sample.late else 0,
    )
    # Faults first: what a broken sensor seems to cross would count against the gains. A lost
    # heartbeat last: a reel may be held for long without one, and its limits have to hold there.
    stop = (
        _fault(limits, watch, following, sample)
        or _crossed(limits, watch, following, sample)
        or _silence(limits, sample)
    )
    return following, stop


def _changed_s(watch: GuardState, sample: Sample) -> float:
    """Time of the last change of the counts; time without readings does not count.

    Else a device that is bridged for longer than frozen_s would be called frozen.
    """
    if sample.held:
        # The first sample has none before it, and its step is infinite: with that a gauge that
        # hangs from the start would never count as frozen.
        return min(watch.changed_s + sample.time_s - watch.time_s, sample.time_s)
    return watch.changed_s if sample.gauge_counts == watch.gauge_counts else sample.time_s


def _fault(  # noqa: PLR0911  a return for each fault, the most severe first
    limits: Limits, watch: GuardState, following: GuardState, sample: Sample
) -> GuardTrip | None:
    """A fault around the reel. Comparisons are written so that a NaN fails them."""
    now, gap = sample.time_s, sample.time_s - watch.time_s
    # Beyond the calibration: the controller would pull against a tension that is not there.
    if not math.isfinite(sample.tension_N):
        return GuardTrip(
            Reason.READING,
            f"the gauge reads {sample.gauge_counts:g} counts, which is no "
            f"{limits.words.measured} within its calibration",
        )
    if not math.isfinite(sample.angle_rad):
        return GuardTrip(Reason.READING, f"the encoder's angle is {sample.angle_rad} rad")
    # With a clock that stands still no time limit below would ever be reached.
    if not gap > 0.0:
        return GuardTrip(
            Reason.CLOCK, f"the driver's time stamp went from {watch.time_s:.6f} to {now:.6f} s"
        )
    # Between samples the last effort stays: a stalled computer drives the reel blindly. The first
    # sample has none before it, and its gap is infinite.
    if math.inf > gap > limits.gap_s:
        return GuardTrip(Reason.LATE, f"{_ms(gap)} between two samples; limit {_ms(limits.gap_s)}")
    if following.late_in_a_row > limits.late_in_a_row:
        return GuardTrip(
            Reason.LATE,
            f"{following.late_in_a_row} late samples in a row; limit {limits.late_in_a_row:g}",
        )
    # A gauge that hangs repeats a plausible tension, and the integral winds up against it.
    if not now - following.changed_s <= limits.frozen_s:
        return GuardTrip(
            Reason.FROZEN,
            f"the gauge has read exactly {sample.gauge_counts:g} counts for "
            f"{_ms(now - following.changed_s)}; limit {_ms(limits.frozen_s)}",
        )
    # A trial that goes on for longer holds the reel by gains that nobody has tried before.
    if not now - watch.start_s <= limits.duration_s:
        return GuardTrip(
            Reason.DEADLINE,
            f"{now - watch.start_s:.3f} s since the start; limit {limits.duration_s:.3f} s",
        )
    return None


def _crossed(  # noqa: PLR0911  a return for each limit, the most severe first
    limits: Limits, watch: GuardState, following: GuardState, sample: Sample
) -> GuardTrip | None:
    """A limit violated by the reel itself; the readings are finite."""
    now, tension, angle = sample.time_s, sample.tension_N, sample.angle_rad
    measured, unit, current, current_unit = limits.words
    if tension > limits.tension_max_N:
        return _over(Reason.TENSION, measured, tension, limits.tension_max_N, unit)
    # The loop pulls against no tension: the drum speeds up until the cable jerks taut.
    if now - following.taut_s > limits.slack_s:
        return GuardTrip(
            Reason.SLACK,
            f"the cable has been slack, below {limits.slack_N:g} {unit}, for "
            f"{_ms(now - following.taut_s)} ({measured} {tension:.4g} {unit}); "
            f"limit {_ms(limits.slack_s)}",
        )
    # A jerk shows here before the tension has reached its limit.
    rate = (tension - watch.tension_N) / (now - watch.time_s)
    if abs(rate) > limits.rate_max_N_s:  # no number at the first sample
        return _over(
            Reason.RATE, f"rate of the {measured}", rate, limits.rate_max_N_s, f"{unit}/s"
        )
    # A motor bears its peak current for a short time only; then it overheats.
    if now - following.within_s > limits.current_s:
        return GuardTrip(
            Reason.CURRENT,
            f"{current} {sample.current_A:.4g} {current_unit}, above {limits.current_max_A:g} "
            f"{current_unit} for "
            f"{_ms(now - following.within_s)}; limit {_ms(limits.current_s)}",
        )
    if not limits.angle_min_rad <= angle <= limits.angle_max_rad:
        return GuardTrip(
            Reason.ANGLE,
            f"angle {angle:.4g} rad; limits {limits.angle_min_rad:g} to "
            f"{limits.angle_max_rad:g} rad",
        )
    # A cable that slips through its clamp lets the drum turn without end at a fair tension.
    travel = angle - watch.start_rad
    if abs(travel) > limits.travel_max_rad:
        return _over(Reason.TRAVEL, "rotation so far", travel, limits.travel_max_rad, "rad")
    # A slow instability shows in the cost before the tension reaches its limit.
    if not sample.cost <= limits.cost_max:
        return _over(Reason.COST, "cost so far", sample.cost, limits.cost_max, "")
    return None


def _silence(limits: Limits, sample: Sample) -> GuardTrip | None:
    """The rig's program has died, or hangs: nobody is left to pass an abort on."""
    if sample.silence_s <= limits.heartbeat_s:
        return None
    return GuardTrip(
        Reason.HEARTBEAT,
        f"no heartbeat from the supervisor for {_ms(sample.silence_s)}; "
        f"limit {_ms(limits.heartbeat_s)}",
    )


def _over(reason: Reason, what: str, value: float, limit: float, unit: str) -> GuardTrip:
    return GuardTrip(
        reason, f"{what} {with_unit(value, unit, 4)}; limit {with_unit(limit, unit, 6)}"
    )


def _ms(time_s: float) -> str:
    return f"{1e3 * time_s:.4g} ms"
