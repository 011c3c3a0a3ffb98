"""What each event does to a reel in each of its phases."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any

from estune.core.pidf import Coefficients
from estune.hardware.loop_messages import BeginTrial, Refused
from estune.hardware.reel_machine.reel import ReelState
from estune.hardware.shared_memory import MotionPhase, SensorLevels, Word
from estune.reel.guard import GuardTrip, Reason
from estune.support.state_table import StateTable, TableRow
from estune.trial import Outcome

_TRANSIENT = frozenset((Reason.HEARTBEAT, Reason.LATE))
"""Faults that end when the computer keeps its time again."""

_SENSOR_FAULTS = frozenset((Reason.READING, Reason.FROZEN, Reason.CLOCK))
"""Faults that only a person can judge."""


class MotionEvent(StrEnum):
    """What happens to a reel: the rows of the table."""

    BEGIN = "begin"
    SET_GAINS = "set gains"
    CLEAR = "clear"
    STOP = "stop"
    ABORT = "abort"
    SETPOINTS = "setpoints"
    TRIP = "trip"
    SAMPLE = "sample"


# --- a trial is requested: (reel, trial) ---


def begin_from_rest(reel: ReelState, trial: BeginTrial) -> None:
    """Take up the cable, then begin the trial."""
    reel.trial.note(trial)
    reel.begin_take_up()


def begin_from_hold(reel: ReelState, trial: BeginTrial) -> None:
    """Move to the preload, then begin the trial."""
    reel.trial.note(trial)


# --- gains become the live ones: (reel, gains) ---


def set_gains(reel: ReelState, live: Coefficients) -> None:
    """Use them from the next sample on, without a jump of the effort."""
    reel.control.fix_live(live)
    reel.control.use_live()


def set_gains_later(reel: ReelState, live: Coefficients) -> None:
    """Use them when the trial has ended."""
    reel.control.fix_live(live)


# --- a latched stop is cleared: (reel) ---


def clear(reel: ReelState) -> None:
    """Take trials again, unless the emergency stop is still pressed."""
    # Its reason would be gone while it still holds the reel.
    if not reel.memory.words[Word.ESTOP]:
        reel.latched = False
        reel.memory.words[Word.LATCHED] = False
        reel.memory.reason = ""


# --- an emergency stop, or the end of the rig's program: (reel, outcome, sentence) ---


def stop_trial(reel: ReelState, outcome: Outcome, sentence: str) -> None:
    """End the trial, latch, and bring the effort to that of the safe state."""
    reel.end_trial(outcome, sentence, reel.trial.k + 1)
    reel.latch(sentence)
    reel.begin_ramp()


def stop_moving(reel: ReelState, outcome: Outcome, sentence: str) -> None:
    """Refuse a requested trial, latch, and bring the effort to that of the safe state."""
    stop_at_rest(reel, outcome, sentence)
    reel.begin_ramp()


def stop_at_rest(reel: ReelState, outcome: Outcome, sentence: str) -> None:
    """Refuse a requested trial, and latch."""
    reel.refuse_trial(outcome, sentence)
    reel.latch(sentence)


# --- the requested trial is aborted: (reel) ---


def abort_trial(reel: ReelState) -> None:
    """End the trial, and hold the reel by the live gains."""
    outcome = Outcome.CANCELLED
    reel.end_trial(outcome, outcome.sentence, reel.trial.k + 1)


def abort_request(reel: ReelState) -> None:
    """Drop the trial, which has not begun."""
    reel.refuse_trial(Outcome.CANCELLED, Outcome.CANCELLED.sentence)


# --- a stream of setpoints begins: (reel) ---


def follow_from_rest(reel: ReelState) -> None:
    """Take up the cable, unless a stop is latched."""
    if not reel.latched:
        reel.begin_take_up()


def follow(_: ReelState) -> None:
    """Follow it once no trial is requested."""


# --- the guard trips: (reel, trip, time in s, tension in N) ---


def trip_in_trial(reel: ReelState, trip: GuardTrip, time_s: float, tension_N: float) -> None:
    """End the trial; the live gains hold the reel where they can, else ramp."""
    reel.memory.reason = trip.sentence
    by_gains = trip.reason.is_caused_by_gains
    outcome = Outcome.GUARD if by_gains else Outcome.INTERRUPTED
    reel.end_trial(outcome, trip.sentence, reel.trial.k + 1)
    if _holds(reel, trip):
        # The tension is still beyond its limit: at once the guard would trip again, and ramp.
        reel.guard.relax_until(time_s + reel.plan.safe.recover_s)
        reel.setpoint.start_at(tension_N)
        reel.control.rest(tension_N, reel.setpoint.tension_N)
        return
    # What a person must look at first; a limit crossed by the trial's gains is over with them.
    reel.latched = trip.reason in _SENSOR_FAULTS
    reel.begin_ramp()


def trip_in_hold(reel: ReelState, trip: GuardTrip, _time_s: float, _tension_N: float) -> None:
    """Refuse a trial; ramp, unless only the heartbeat is lost; latch, but for a late computer."""
    _refuse(reel, trip)
    if _holds(reel, trip) and trip.reason in _TRANSIENT:
        return  # this is the safe state
    # A late computer ramps, and is not latched.
    reel.latched = trip.reason not in _TRANSIENT
    reel.begin_ramp()


def trip_in_take_up(reel: ReelState, trip: GuardTrip, _time_s: float, _tension_N: float) -> None:
    """Refuse a requested trial and ramp; latch, but for a stalled computer."""
    _refuse(reel, trip)
    reel.latched = trip.reason not in _TRANSIENT
    reel.begin_ramp()


def _refuse(reel: ReelState, trip: GuardTrip) -> None:
    reel.memory.reason = trip.sentence
    # Nothing has moved by the trial's gains: where the cause has passed it may be asked for again.
    outcome = Outcome.CANCELLED if trip.reason in _TRANSIENT else Outcome.INTERRUPTED
    reel.refuse_trial(outcome, trip.sentence)


def _holds(reel: ReelState, trip: GuardTrip) -> bool:
    return reel.plan.safe.hold and trip.reason.leaves_control


# --- the effort of a sample: (reel, time in s, tension in N), effort in N ---


def rest(_reel: ReelState, _time_s: float, _tension_N: float) -> float:
    """No effort."""
    return 0.0


def take_up(reel: ReelState, time_s: float, tension_N: float) -> float:
    """A constant effort until the cable is taut; then hold."""
    motion = reel.plan.motion
    # Closed on a slack cable, the loop would speed the drum up until the cable jerks taut.
    if not tension_N >= motion.taut_N:
        return motion.take_up_N
    reel.phase = MotionPhase.HOLD
    reel.control.close(tension_N, reel.effort_N)
    reel.setpoint.start_at(tension_N)
    return hold(reel, time_s, tension_N)


def hold(reel: ReelState, _time_s: float, tension_N: float) -> float:
    """The live gains; the trial begins once the reel has settled at its preload."""
    trial, setpoint = reel.trial, reel.setpoint
    setpoint.move(trial.preload_N)
    effort = reel.control.hold(
        *(setpoint, tension_N, reel.angle_rad, reel.effort_N),
        tension_only=trial.request is not None,
    )
    if trial.request is not None:
        settled = trial.is_settled(setpoint.tension_N, tension_N)
        if isinstance(settled, Refused):
            trial.request, reel.answer = None, settled
        elif settled:  # the next sample is the trial's first
            reel.phase, trial.k = MotionPhase.TRIAL, 0
            reel.guard.begin_trial(trial.request)
            reel.control.use_trial(trial.request)
    return effort


def run(reel: ReelState, time_s: float, tension_N: float) -> float:
    """The gains of the trial, until its last sample; then hold."""
    trial = reel.trial.under_way
    setpoint_N = reel.trial.next_setpoint(time_s)
    effort = reel.control.run(trial, setpoint_N, tension_N, reel.effort_N)
    if reel.trial.k == trial.samples:
        reel.end_trial(Outcome.DONE, "", trial.samples)
    return effort


def ramp(reel: ReelState, time_s: float, _tension_N: float) -> float:
    """A ramp to the effort of the safe state; then stopped."""
    # By time: a device that does not answer makes samples many times as long as a period.
    # No less than a sample: a device's clock that crawls would keep the effort up.
    passed_s = time_s - reel.memory.levels[SensorLevels.TIME_s]
    samples = max(passed_s * reel.plan.sampling_Hz, 1.0)
    target, step = reel.plan.safe.effort_N, reel.ramp_step_N * samples
    effort: float = reel.effort_N + step
    if step == 0.0 or (target - effort) * step <= 0.0:
        reel.phase = MotionPhase.STOPPED
        return target
    return effort


def stay_safe(reel: ReelState, _time_s: float, _tension_N: float) -> float:
    """The effort of the safe state."""
    return reel.plan.safe.effort_N


# --- table ---

Change = Callable[..., Any]
"""A function of the reel and of what its event brings; that of a sample returns its effort."""

_HOLD, _TRIAL, _TAKE_UP = (MotionPhase.HOLD,), (MotionPhase.TRIAL,), (MotionPhase.TAKE_UP,)
_AT_REST = (MotionPhase.OFF, MotionPhase.STOPPED)

TABLE: StateTable[MotionEvent, MotionPhase, Change] = StateTable(
    MotionPhase,
    {
        MotionEvent.BEGIN: TableRow(
            begin_from_rest, (begin_from_hold, _HOLD), ("a trial is running", _TRIAL)
        ),
        MotionEvent.SET_GAINS: TableRow(set_gains, (set_gains_later, _TRIAL)),
        MotionEvent.CLEAR: TableRow(clear),
        MotionEvent.STOP: TableRow(
            stop_at_rest, (stop_trial, _TRIAL), (stop_moving, _TAKE_UP + _HOLD)
        ),
        MotionEvent.ABORT: TableRow(abort_request, (abort_trial, _TRIAL)),
        MotionEvent.SETPOINTS: TableRow(follow, (follow_from_rest, _AT_REST)),
        MotionEvent.TRIP: TableRow(
            "the guard only watches a reel that is moved",
            (trip_in_take_up, _TAKE_UP),
            (trip_in_hold, _HOLD),
            (trip_in_trial, _TRIAL),
        ),
        MotionEvent.SAMPLE: TableRow(
            rest,
            (take_up, _TAKE_UP),
            (hold, _HOLD),
            (run, _TRIAL),
            (ramp, (MotionPhase.RAMP,)),
            (stay_safe, (MotionPhase.STOPPED,)),
        ),
    },
)
"""Function, or the reason why there is none, by event and phase."""
