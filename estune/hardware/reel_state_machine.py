"""State machine of the reel at each sample: guard, phase, controller; no clock, no hardware.

::

    OFF ──begin──► TAKE_UP ──taut──► HOLD ──settled at the preload──► TRIAL ──► HOLD
                      │                │  ◄──── guard, safe state "hold" ───┤
                      └──── guard ─────┴──────────────► RAMP ◄──── guard ───┘
                                                          └──► STOPPED ──begin──► TAKE_UP

What the guard finds at a sample decides the current commanded at that same sample. A stop caused
by a trial's gains, or by a stalled computer, ends with the next trial. Any other is latched: the
rig takes no trial until an operator has cleared it.
"""

import math

from estune.core.pidf import Coefficients
from estune.hardware.compensation.plan import NO_COMPENSATION, CompensationTerms, KnownMotion
from estune.hardware.compensation.runtime import Compensation
from estune.hardware.controller import Controller
from estune.hardware.driver import Reading
from estune.hardware.guard_watch import GuardWatch
from estune.hardware.hybrid_control import HybridControl
from estune.hardware.live_gains import LiveGains
from estune.hardware.loop_messages import Begin, Ended, LoopPlan, Refused
from estune.hardware.shared_memory import Memory, MotionPhase, SensorLevels, Word
from estune.reel.guard import GuardTrip, Reason, Sample
from estune.reel.hybrid import HybridSignals
from estune.trial import GUARD, LATE, SATURATED, SETPOINT_S, Outcome

_TRANSIENT = frozenset((Reason.HEARTBEAT, Reason.LATE))
"""Faults that end when the computer keeps its time again."""

_SENSOR_FAULTS = frozenset((Reason.READING, Reason.FROZEN, Reason.CLOCK))
"""Faults that only a person can judge."""

_UNGUARDED = frozenset((MotionPhase.OFF, MotionPhase.RAMP, MotionPhase.STOPPED))


class ReelStateMachine:
    """The reel's behaviour, one sample at a time.

    Attributes:
        phase: Current phase.
        answer: Result of the requested trial; the loop takes and resets it.
    """

    def __init__(
        self,
        plan: LoopPlan,
        memory: Memory,
        controller: Controller,
        compensation: Compensation,
        hybrid: HybridControl | None = None,
    ) -> None:
        self.phase = MotionPhase.OFF
        self.answer: Ended | Refused | None = None
        self._plan = plan
        self._memory = memory
        self._controller = controller
        self._compensation, self._hybrid = compensation, hybrid
        self._forward_N = 0.0
        self._filtered_N = math.nan
        self._live = LiveGains(plan.live, plan.length_source)
        self._angle_rad = 0.0
        self._guard = GuardWatch(plan, memory)
        self._latched = False
        self._effort_N = 0.0
        self._setpoint_N = plan.motion.hold_N
        self._is_gain_change_pending = False
        self._settled = self._at_preload = 0
        self._setpoints = 0  # taken so far
        self._in_force_until_s = -math.inf
        self._follows = False
        self._trial: Begin | None = None
        self._k = 0
        self._first_s = math.nan
        self._ramp_step_N = 0.0
        self._limited = False
        controller.use(plan.live)

    @property
    def powered(self) -> bool:
        """Whether the amplifier must have power."""
        if self.phase is MotionPhase.STOPPED:
            return self._plan.safe.effort_N != 0.0
        return self.phase is not MotionPhase.OFF

    @property
    def at_rest(self) -> bool:
        """Whether the loop may end."""
        return self.phase in (MotionPhase.OFF, MotionPhase.STOPPED)

    def begin(self, trial: Begin) -> None:
        """Accepts a trial, or refuses it."""
        if self._latched or self._memory.words[Word.ESTOP]:
            why = self._memory.reason or "emergency stop"
            self.answer = Refused(f"it has stopped ({why}); check it, then clear it")
            return
        self._trial = trial
        self._memory.words[Word.PROGRESS] = 0
        if self.phase is not MotionPhase.HOLD:
            self._begin_take_up()
        self._settled = self._at_preload = 0

    def set_live_gains(self, live: Coefficients) -> None:
        """Makes gains the live ones, fixed, without a jump of the effort."""
        self._live.fix(live)
        if self.phase is not MotionPhase.TRIAL:
            self._controller.use(live)
            self._is_gain_change_pending = True

    def reset(self) -> None:
        """Clears a latched stop."""
        if not self._memory.words[Word.ESTOP]:
            self._latched = False
            self._memory.words[Word.LATCHED] = False
            self._memory.reason = ""

    def shut_down(self, sentence: str) -> None:
        """Brings the reel to rest, latched."""
        self._stop(Outcome.INTERRUPTED, sentence)

    def sample(self, reading: Reading, silence_s: float, *, late: bool) -> int:
        """One sample; the current command, counts.

        Args:
            reading: What the driver read.
            silence_s: Time since the rig's last heartbeat, s.
            late: Whether the sample began late.
        """
        plan, memory = self._plan, self._memory
        gauge = plan.gauge.force_N(reading.gauge_counts)
        angle = reading.encoder_counts * plan.radians_per_count
        terms = self._compensate(reading.time_s, gauge, angle)
        tension = gauge - terms.gravity_N
        recorded, k = self.phase is MotionPhase.TRIAL, self._k
        flags = LATE if late else 0
        if memory.words[Word.ESTOP] and not self._latched:
            self._stop(Outcome.CANCELLED, f"emergency stop: {memory.estop_reason}")
        elif self._trial is not None and memory.words[Word.ABORT] == self._trial.number:
            self._end_early(Outcome.CANCELLED, Outcome.CANCELLED.sentence)
        self._take_setpoint(reading.time_s)
        if self.phase not in _UNGUARDED:
            commanded_A = self._effort_N / plan.newtons_per_ampere
            counts = reading.gauge_counts
            seen = Sample(reading.time_s, gauge, counts, commanded_A, angle, late, silence_s)
            if (stop := self._guard.check(self.phase, seen, self._k)) is not None:
                flags |= GUARD
                self._trip(stop, reading.time_s, tension)
        self._angle_rad = angle
        self._effort_N = self._next_effort(reading.time_s, tension)
        closed = self.phase in (MotionPhase.HOLD, MotionPhase.TRIAL)
        in_tension = self._hybrid is None or self._hybrid.in_tension
        self._filtered_N = (
            self._controller.filtered_setpoint_N if closed and in_tension else math.nan
        )
        current = self._effort_N / plan.newtons_per_ampere
        if recorded:
            memory.record(
                k,
                time_s=reading.time_s - self._first_s,
                tension_N=tension,
                current_A=current,
                angle_rad=angle,
                drum_velocity_rad_s=terms.velocity_rad_s,
                gravity_N=terms.gravity_N,
                friction_A=terms.friction_N / plan.newtons_per_ampere,
                inertia_A=terms.inertia_N / plan.newtons_per_ampere,
                flags=flags | (SATURATED if self._limited else 0),
            )
        memory.publish(
            self.phase,
            latched=self._latched,
            in_position=self._hybrid is not None and not self._hybrid.in_tension,
            levels=(
                *(reading.time_s, self._setpoint_N, tension, current, angle),
                *self._live.operating_point,
            ),
        )
        return plan.current.counts(current)

    def _compensate(self, time_s: float, gauge_N: float, angle_rad: float) -> CompensationTerms:
        """The compensations at this sample; in an open loop they would alter what is asked for."""
        trial = self._trial
        is_open = self.phase is MotionPhase.TRIAL and trial is not None and trial.open_loop
        filtered = math.nan if is_open else self._filtered_N
        known = KnownMotion(filtered, self._memory.far_end_m_s[0] if self._follows else 0.0)
        terms = self._compensation.sample(time_s, gauge_N, angle_rad, known)
        if is_open:
            terms = NO_COMPENSATION._replace(velocity_rad_s=terms.velocity_rad_s)
        self._forward_N = terms.feed_forward_N
        self._controller.feed_forward(self._forward_N)
        return terms

    def _begin_take_up(self) -> None:
        self.phase = MotionPhase.TAKE_UP
        self._guard.restart()

    def _take_setpoint(self, time_s: float) -> None:
        """Notes a setpoint from above; the first one of a stream takes up a reel at rest."""
        count = self._memory.words[Word.SETPOINTS]
        if count != self._setpoints:
            begins = time_s > self._in_force_until_s
            self._setpoints, self._in_force_until_s = count, time_s + SETPOINT_S
            if begins and self.at_rest and not self._latched:
                self._begin_take_up()
        self._follows = time_s <= self._in_force_until_s

    def _trip(self, stop: GuardTrip, time_s: float, tension_N: float) -> None:
        """Goes to the safe state."""
        was, safe = self.phase, self._plan.safe
        holds = safe.hold and stop.reason.leaves_control
        self._memory.reason = stop.sentence
        caused_by_gains = stop.reason.is_caused_by_gains
        self._end_early(Outcome.GUARD if caused_by_gains else Outcome.INTERRUPTED, stop.sentence)
        if was is MotionPhase.TRIAL and holds:
            self._guard.relax_until(time_s + safe.recover_s)
            self._recover(tension_N)
            return
        if was is MotionPhase.HOLD and holds and stop.reason in _TRANSIENT:
            return  # this is the safe state
        self._latched = stop.reason in _SENSOR_FAULTS or (
            was is not MotionPhase.TRIAL and stop.reason not in _TRANSIENT
        )
        self._ramp()

    def _recover(self, tension_N: float) -> None:
        """Starts the live gains as if the reel had settled here.

        Not bumpless: the last effort is that of gains which have just failed.
        """
        self._start_setpoint_at(tension_N)
        self._controller.rest(tension_N, self._setpoint_N)
        self._is_gain_change_pending = False

    def _stop(self, outcome: Outcome, sentence: str) -> None:
        """Ends the trial, if any, and brings the reel to rest, latched."""
        self._end_early(outcome, sentence)
        self._memory.reason = sentence
        self._latched = True
        if not self.at_rest:
            self._ramp()

    def _ramp(self) -> None:
        if self.phase is MotionPhase.RAMP:
            return
        samples = max(1, round(self._plan.safe.ramp_s * self._plan.sampling_Hz))
        self._ramp_step_N = (self._plan.safe.effort_N - self._effort_N) / samples
        self.phase = MotionPhase.RAMP

    def _end_early(self, outcome: Outcome, sentence: str) -> None:
        """Ends the trial, under way or not begun, if there is one."""
        if self.phase is MotionPhase.TRIAL:
            self._end(outcome, sentence, self._k + 1)
        elif self._trial is not None:
            if outcome is Outcome.CANCELLED:
                self.answer = Ended(self._trial.number, 0, outcome, sentence, math.nan)
            else:
                self.answer = Refused(f"it stopped before the trial began: {sentence}")
            self._trial = None

    def _end(self, outcome: Outcome, sentence: str, kept: int) -> None:
        """Ends the trial under way and restores the live gains."""
        assert self._trial is not None  # noqa: S101  a trial is under way
        self.answer = Ended(self._trial.number, kept, outcome, sentence, self._first_s)
        last = self._memory.setpoint_N[kept - 1]
        open_loop, self._trial = self._trial.open_loop, None
        self.phase = MotionPhase.HOLD
        self._guard.end_trial()
        self._controller.use(self._live.coefficients)
        self._start_setpoint_at(self._memory.levels[SensorLevels.TENSION_N] if open_loop else last)

    def _start_setpoint_at(self, tension_N: float) -> None:
        """Starts the setpoint here, within its limits, without a jump of the effort."""
        self._setpoint_N = self._within_limits(tension_N)
        self._is_gain_change_pending = True

    def _within_limits(self, tension_N: float) -> float:
        """A tension within the limits of setpoints, N."""
        return min(max(tension_N, self._plan.tension_min_N), self._plan.tension_max_N)

    def _next_effort(self, time_s: float, tension_N: float) -> float:
        """Effort of the phase, N, and the transitions between phases."""
        self._limited = False
        match self.phase:
            case MotionPhase.TAKE_UP:
                return self._take_up(tension_N)
            case MotionPhase.HOLD:
                return self._hold(tension_N)
            case MotionPhase.TRIAL:
                return self._run(time_s, tension_N)
            case MotionPhase.RAMP:
                return self._follow_ramp()
            case MotionPhase.STOPPED:
                return self._plan.safe.effort_N
        return 0.0

    def _take_up(self, tension_N: float) -> float:
        motion = self._plan.motion
        if not tension_N >= motion.taut_N:
            return motion.take_up_N
        self.phase = MotionPhase.HOLD
        if self._hybrid is not None:
            self._hybrid.pause()
        self._controller.use(self._live.coefficients)
        self._controller.rest(tension_N, self._effort_N)
        self._start_setpoint_at(tension_N)
        return self._hold(tension_N)

    def _hold(self, tension_N: float) -> float:
        """Moves the setpoint to its target, or follows one from above; starts the trial there."""
        motion, trial = self._plan.motion, self._trial
        target = motion.hold_N if trial is None else self._memory.setpoint_N[0]
        step = motion.rate_N_s / self._plan.sampling_Hz
        if trial is None and self._follows:
            self._setpoint_N = self._memory.target_N[0]
        else:
            self._setpoint_N += min(max(target - self._setpoint_N, -step), step)
        changed = self._live.update(self._angle_rad, self._setpoint_N)
        if self._is_gain_change_pending:
            self._controller.use(self._live.coefficients)
            self._controller.take_over(self._setpoint_N, tension_N, self._effort_N)
            self._is_gain_change_pending = False
        elif changed:
            self._controller.exchange(self._live.coefficients, self._setpoint_N, tension_N)
        effort = self._held_effort(tension_N)
        if trial is not None:
            self._settle(trial, tension_N)
        return effort

    def _held_effort(self, tension_N: float) -> float:
        """Effort by tension control, or by position control where that is asked for."""
        hybrid, target_rad = self._hybrid, self._memory.target_rad[0]
        solved = self._trial is not None or not self._follows or math.isnan(target_rad)
        if hybrid is None or (solved and hybrid.in_tension):
            if hybrid is not None:
                hybrid.pause()
            effort = self._controller.step(self._setpoint_N, tension_N)
            self._limited = self._controller.limited
            return effort
        in_tension, self._setpoint_N = hybrid.select(
            tension_N, self._setpoint_N, self._within_limits(tension_N), solved=solved
        )
        radius, angle = hybrid.plan.drum_radius_m, self._angle_rad
        target_m = radius * (angle if math.isnan(target_rad) else target_rad)
        signals = HybridSignals(target_m, radius * angle, self._setpoint_N, tension_N)
        effort = hybrid.step(signals, self._forward_N, in_tension=in_tension)
        self._limited = hybrid.limited
        return effort

    def _settle(self, trial: Begin, tension_N: float) -> None:
        """Starts the trial once the tension has stayed at the preload for long enough."""
        motion, rate = self._plan.motion, self._plan.sampling_Hz
        preload = self._memory.setpoint_N[0]
        if self._setpoint_N != preload:
            return
        self._at_preload += 1
        near = abs(tension_N - preload) <= motion.settle_N
        self._settled = self._settled + 1 if near else 0
        if self._settled > motion.settle_s * rate:
            self._start(trial)
        elif self._at_preload > motion.settle_within_s * rate:
            self._trial = None
            self.answer = Refused(
                f"the live gains have not kept the tension within {motion.settle_N:g} N of the "
                f"preload {preload:g} N for {motion.settle_s:g} s, after "
                f"{motion.settle_within_s:g} s: it is {tension_N:.4g} N"
            )

    def _start(self, trial: Begin) -> None:
        """The next sample is the trial's first."""
        self.phase, self._k = MotionPhase.TRIAL, 0
        self._guard.begin_trial(trial)
        if not trial.open_loop:
            self._controller.use(trial.coefficients)
            self._is_gain_change_pending = True

    def _run(self, time_s: float, tension_N: float) -> float:
        """One sample of the trial."""
        trial, k = self._trial, self._k
        assert trial is not None  # noqa: S101  a trial is under way
        setpoint = self._memory.setpoint_N[k]
        if k == 0:
            self._first_s = time_s
        if self._is_gain_change_pending:
            self._controller.take_over(setpoint, tension_N, self._effort_N)
            self._is_gain_change_pending = False
        effort = self._controller.step(setpoint, tension_N)
        self._limited = self._controller.limited
        if trial.open_loop:  # the controller runs along for its filters only
            effort = min(max(setpoint, self._plan.effort_min_N), self._plan.effort_max_N)
            self._limited = effort != setpoint
        self._k = k + 1
        if self._k == trial.samples:
            self._end(Outcome.DONE, "", trial.samples)
        return effort

    def _follow_ramp(self) -> float:
        target = self._plan.safe.effort_N
        effort = self._effort_N + self._ramp_step_N
        if self._ramp_step_N == 0.0 or (target - effort) * self._ramp_step_N <= 0.0:
            self.phase = MotionPhase.STOPPED
            return target
        return effort
