"""The reel's behaviour, one sample at a time."""

from estune.core.pidf import Coefficients
from estune.hardware.compensation.runtime import Compensation
from estune.hardware.controller import Controller
from estune.hardware.driver import Reading
from estune.hardware.hybrid_control import HybridControl
from estune.hardware.loop_messages import BeginTrial, Ended, LoopPlan, Refused, SetCompensation
from estune.hardware.reel_machine.bridge import Bridge, bridge
from estune.hardware.reel_machine.reel import ReelState
from estune.hardware.reel_machine.transitions import TABLE, Change, MotionEvent
from estune.hardware.shared_memory import Memory, MotionPhase, Word
from estune.reel.guard import Sample
from estune.trial import GUARD, LATE, SATURATED, Outcome

REST_s = 0.5
"""Time without a good reading after which a reel at rest takes no trial until it is cleared, s:
nothing moves, and a board that starts again, or a line that is plugged in, takes its time."""

_CLOSED = frozenset((MotionPhase.HOLD, MotionPhase.TRIAL))


class ReelStateMachine:
    """The reel's behaviour, one sample at a time."""

    def __init__(
        self,
        plan: LoopPlan,
        memory: Memory,
        controller: Controller,
        compensation: Compensation,
        hybrid: HybridControl | None = None,
    ) -> None:
        self._plan, self._memory = plan, memory
        self._bridge = Bridge()
        self._without_power = False
        self._reel = ReelState(plan, memory, controller, compensation, hybrid)

    @property
    def phase(self) -> MotionPhase:
        """Current phase."""
        return self._reel.phase

    @property
    def powered(self) -> bool:
        """Whether the amplifier must have power."""
        if self.phase is MotionPhase.STOPPED:
            return self._plan.safe.effort_N != 0.0 and not self._without_power
        return self.phase is not MotionPhase.OFF

    @property
    def at_rest(self) -> bool:
        """Whether the loop may end."""
        return self.phase in (MotionPhase.OFF, MotionPhase.STOPPED)

    @property
    def answer(self) -> Ended | Refused | None:
        """Result of the requested trial; the loop takes and resets it."""
        return self._reel.answer

    @answer.setter
    def answer(self, answer: Ended | Refused | None) -> None:
        self._reel.answer = answer

    def begin(self, trial: BeginTrial) -> None:
        """Accepts a trial, or refuses it."""
        reel = self._reel
        # The word, too: a stop since the last sample is not latched yet.
        if reel.latched or self._memory.words[Word.ESTOP]:
            why = self._memory.reason or "emergency stop"
            reel.answer = Refused(f"it has stopped ({why}); check it, then clear it")
            return
        cell = self._cell(MotionEvent.BEGIN)
        if isinstance(cell, str):
            reel.answer = Refused(cell)
        else:
            cell(reel, trial)

    def remove_power(self) -> None:
        """Removes the power of a stopped reel whose device is lost, until it is cleared."""
        self._without_power = True

    def set_live_gains(self, live: Coefficients) -> None:
        """Makes gains the live ones, fixed, without a jump of the effort."""
        self._apply(MotionEvent.SET_GAINS, live)

    def set_compensation(self, own: SetCompensation) -> None:
        """Makes compensations those between trials and of trials that ask for no others."""
        self._reel.control.set_compensation(own.plan, own.source)

    def reset(self) -> None:
        """Clears a latched stop; the next good reading is then believed, wherever it is."""
        # A drum that was turned by hand meanwhile is no jump of the encoder.
        self._bridge = self._bridge._replace(last=None)
        self._without_power = False
        self._apply(MotionEvent.CLEAR)

    def shut_down(self, sentence: str) -> None:
        """Brings the reel to rest, latched."""
        self._apply(MotionEvent.STOP, Outcome.INTERRUPTED, sentence)

    def sample(self, reading: Reading, silence_s: float, *, late: bool) -> int:
        """One sample; the current command, counts.

        Args:
            reading: What the driver read.
            silence_s: Time since the rig's last heartbeat, s.
            late: Whether the sample began late.
        """
        plan, memory, reel = self._plan, self._memory, self._reel
        reading = self._believe(reading)
        time_s = reading.time_s
        gauge = plan.gauge.force_N(reading.gauge_counts)
        angle = reading.encoder_counts * plan.radians_per_count
        recorded, k = reel.phase is MotionPhase.TRIAL, reel.trial.k
        reel.control.select_compensation(reel.trial.request)
        terms = reel.control.compensate(
            *(time_s, gauge, angle, reel.setpoint.far_end_m_s),
            is_open=recorded and reel.trial.under_way.open_loop,
        )
        tension = gauge - terms.off_gauge_N
        flags = LATE if late or reading.fault else 0
        self._take_orders(time_s)
        if self._stop_unread(reading):
            flags = GUARD
        trip = self._cell(MotionEvent.TRIP)
        if not isinstance(trip, str):
            commanded_A = reel.effort_N / plan.newtons_per_ampere
            counts = reading.gauge_counts
            seen = Sample(
                *(time_s, gauge, counts, commanded_A, angle, late, silence_s),
                held=bool(reading.fault),
            )
            if (stop := reel.guard.check(reel.phase, seen, reel.trial.k)) is not None:
                flags |= GUARD
                trip(reel, stop, time_s, tension)
        reel.angle_rad = angle
        reel.control.limited = False
        reel.effort_N = self._apply(MotionEvent.SAMPLE, time_s, tension)
        reel.control.note_setpoint(closed=reel.phase in _CLOSED)
        current = reel.effort_N / plan.newtons_per_ampere
        setpoint_N = memory.setpoint_N[k] if recorded else reel.setpoint.tension_N
        flags |= SATURATED if reel.control.limited else 0
        if recorded:
            memory.record(
                k,
                time_s=time_s - reel.trial.first_s,
                tension_N=tension,
                current_A=current,
                angle_rad=angle,
                **terms.columns(1.0 / plan.newtons_per_ampere),
                flags=flags,
            )
        memory.publish(
            reel.phase,
            latched=reel.latched,
            in_position=reel.control.in_position,
            levels=(
                *(time_s, setpoint_N, tension, current, angle),
                *reel.control.operating_point,
            ),
            flags=flags,
        )
        return plan.current.counts(current)

    def _believe(self, reading: Reading) -> Reading:
        """The reading, or the last good one in place of a bad one."""
        plan, memory = self._plan, self._memory
        self._bridge, reading = bridge(
            *(plan.bad_readings, self._bridge, reading), period_s=1.0 / plan.sampling_Hz
        )
        if reading.fault:
            memory.fault = reading.fault
            memory.words[Word.BAD] += 1
        return reading

    def _stop_unread(self, reading: Reading) -> bool:
        """Stops and latches the reel if it can no longer be measured; whether it did so now."""
        rule, reel, bad = self._plan.bad_readings, self._reel, self._bridge.bad
        age_s = reading.age_s if self._bridge.last else bad / self._plan.sampling_Hz
        lost = age_s > REST_s if self.at_rest else bad > rule.in_a_row or age_s > rule.seconds
        if reel.latched or not (bad and lost):
            return False
        sentence = (
            f"{reading.fault} ({bad} bad reading{'s' * (bad > 1)} in a row, "
            f"{1e3 * age_s:.4g} ms without a good one)"
        )
        self._apply(MotionEvent.STOP, Outcome.INTERRUPTED, sentence)
        return True

    def _take_orders(self, time_s: float) -> None:
        """Stop, abort and setpoints that others have written to the shared memory."""
        memory, reel, request = self._memory, self._reel, self._reel.trial.request
        if memory.words[Word.ESTOP] and not reel.latched:
            sentence = f"emergency stop: {memory.estop_reason}"
            self._apply(MotionEvent.STOP, Outcome.CANCELLED, sentence)
        elif request is not None and memory.words[Word.ABORT] == request.number:
            self._apply(MotionEvent.ABORT)
        if reel.setpoint.take(time_s):
            self._apply(MotionEvent.SETPOINTS)

    def _cell(self, event: MotionEvent) -> Change | str:
        return TABLE.cell(event, self._reel.phase)

    def _apply(self, event: MotionEvent, *brings: object) -> float:
        """Does what the table says of an event without a reason against it."""
        cell = self._cell(event)
        return 0.0 if isinstance(cell, str) else cell(self._reel, *brings)
