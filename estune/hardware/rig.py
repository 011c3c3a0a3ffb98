"""Rig of a reel on real hardware."""

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, RigError
from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.compensation.runtime import make_compensation
from estune.hardware.compensation.tables import CompensationTable, table_of
from estune.hardware.config import RigConfig
from estune.hardware.loop_messages import (
    BeginTrial,
    Done,
    Ended,
    LoopPlan,
    ResetEstop,
    SetCompensation,
    SetLiveGains,
)
from estune.hardware.process import ANSWER_WITHIN_s, LoopProcess, RunningLoop
from estune.hardware.shared_memory import MotionPhase, SensorLevels, Timing, Word
from estune.support.closing import Closing
from estune.trial import (
    Feedback,
    Outcome,
    RigDescription,
    Setpoint,
    Telemetry,
    TrialRecord,
    TrialRequest,
)
from estune.trial.executed_trials import ExecutedTrials, stopped_trial
from estune.trial.profiles import Profile, StepProfile
from estune.trial.records import record_of

JUMP_s = 1.0
"""Jump of the time of day between two trials that is logged."""

TINY = float(np.finfo(np.float64).tiny)

_log = logging.getLogger(__name__)


class HardwareRig(Closing):
    """Runs trials on hardware; a `Rig` with its errors, also where the loop has failed.

    The loop is a process of its own. The hardware has no power before the first trial; from then
    on the live gains hold it between trials. Any thread may call: one trial runs at a time;
    `abort` and `estop` wait for no other call. A context manager.

    Attributes:
        notes: Requests of the loop to the system that were not granted, a line each.
    """

    def __init__(
        self, config: RigConfig, start: Callable[[str, LoopPlan], RunningLoop] = LoopProcess
    ) -> None:
        """Starts the loop.

        Raises:
            InvalidInput: a calibration, or a setting of the driver, cannot be used.
            RigError: the loop does not start, or the driver does not reach its hardware.
        """
        plan = config.plan()
        self._config = config
        self._description = config.describe()
        self._length_source = plan.length_source
        self._compensation = config.compensation
        self._optional_columns = plan.compensation.columns if plan.compensation else ()
        self._cost = StepCost(config.settling_time_s)
        self._live_cost: tuple[Profile, float] | None = None
        self._records = ExecutedTrials()
        self._numbers = 0
        self._day_s = _day_s()
        self._trial = threading.Lock()  # held while a message to the loop awaits its answer
        self._number = 0  # of the requested trial, or zero
        self._trial_id = ""
        self._closed = False
        self._loop = start(config.name, plan)
        self._memory, self.notes = self._loop.memory, self._loop.notes
        for note in self.notes:
            _log.warning("rig %s: %s", self._description.name, note)

    def describe(self) -> RigDescription:
        """Description of the rig, with its live gains."""
        self._check_alive()
        return self._current_description()

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before."""
        with self._trial:
            self._check_alive()
            stored = self._records.find_record(request)
            if stored is not None:
                return stored
            self._description.limits.check(request.profile)
            self._description.check_gains(request.gains, trial=True)
            begin = self._prepare(request, self._trial_compensation(request))
            self._number, self._trial_id = begin.number, request.trial_id
            try:
                answer = self._loop.request(begin, Ended, self._timeout_s(request))
            finally:
                self._number, self._trial_id = 0, ""
            record = self._record(request, answer, begin)
            self._records.add(request, record)
            self._learn_cost(request, record)
            return record

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones, without a jump of the current; a schedule then ends."""
        with self._trial:
            self._check_alive()
            if self._memory.words[Word.ESTOP]:
                raise RigError(
                    f"rig {self._description.name} takes no gains: emergency stop "
                    f"({self._memory.estop_reason}); check it, then clear it"
                )
            self._description.check_gains(gains)
            live = pidf.coefficients(self._description.controller, gains)
            self._loop.request(SetLiveGains(live), Done, ANSWER_WITHIN_s)
            self._description = replace(self._description, gains=gains)
            self._length_source = None
            self._live_cost = None

    def switch_off(self, tables: Sequence[str]) -> None:
        """Switches compensations of the rig's file off, until its next start."""
        with self._trial:
            self._check_alive()
            left = (self._compensation or CompensationTable()).without(tables)
            plan, source = self._compiled(left)
            self._loop.request(SetCompensation(plan, source), Done, ANSWER_WITHIN_s)
            self._compensation, self._live_cost = left, None
            self._optional_columns = plan.columns if plan else ()
            text = left.text if left else ""
            self._description = replace(self._description, compensation=text)

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        self._check_alive()
        with stopped_trial(self._trial, self._stop):
            return self.describe()

    def estop(self, reason: str) -> None:
        """Emergency stop: brings the reel to rest from the next sample on; returns at once.

        The rig takes neither trials nor gains until it is cleared. This is software: a reel that
        can hurt people needs a switch that cuts the amplifier's power, too.
        """
        self._check_alive()
        self._memory.estop_reason = reason or "no reason given"
        self._memory.words[Word.ESTOP] = 1

    def follow(self, setpoint: Setpoint) -> Feedback:
        """Follows a setpoint between trials; the loop itself returns to `hold_N` after it.

        Raises:
            InvalidInput: the setpoint is outside the limits, or for position control.
            RigError: the rig is closed, its loop has failed, or it has stopped.
        """
        self._check_alive()
        self._description.limits.check_setpoint(setpoint.tension_N)
        if setpoint.angle_rad is not None and self._config.hybrid is None:
            raise InvalidInput(
                f"rig {self._description.name} has no position controller; "
                "send tensions only, or add [hybrid] to its file"
            )
        words, levels = self._memory.words, self._memory.levels
        if words[Word.LATCHED] or words[Word.ESTOP]:
            raise RigError(
                f"rig {self._description.name} follows no setpoint: it has stopped "
                f"({self._memory.reason or self._memory.estop_reason}); check it, then clear it"
            )
        self._memory.target_N[0] = setpoint.tension_N
        self._memory.target_rad[0] = math.nan if setpoint.angle_rad is None else setpoint.angle_rad
        self._memory.far_end_m_s[0] = setpoint.far_end_m_s
        words[Word.SETPOINTS] += 1
        return Feedback(
            time_s=levels[SensorLevels.TIME_s],
            tension_N=levels[SensorLevels.TENSION_N],
            angle_rad=levels[SensorLevels.ANGLE_rad],
            current_A=levels[SensorLevels.CURRENT_A],
        )

    def clear(self) -> None:
        """Lets a rig that was stopped, by its guard or by hand, take trials again."""
        with self._trial:
            self._check_alive()
            self._memory.words[Word.ESTOP] = 0
            self._loop.request(ResetEstop(), Done, ANSWER_WITHIN_s)

    def telemetry(self, after: int) -> Telemetry | None:
        """Samples of the trial under way from index `after` on; None if there is none."""
        trial_id, words = self._trial_id, self._memory.words
        measured = words[Word.PROGRESS]
        if not trial_id or words[Word.PHASE] != MotionPhase.TRIAL:
            return None
        memory, first = self._memory, min(after, measured)
        sources = (memory.setpoint_N, memory.tension_N, memory.current_A, memory.angle_rad)
        columns = (np.array(source[first:measured], np.float64) for source in sources)
        return Telemetry(trial_id, first, self._config.sampling_Hz, *columns)

    def motion_since(self, sample: int) -> NDArray[np.void]:
        """Samples after one of this number, in trials and between them; see `Memory`."""
        return self._memory.motion_since(sample)

    @property
    def stop_reason(self) -> str:
        """Why the guard or an operator last stopped the reel; empty if none did."""
        return self._memory.reason

    def timing(self) -> Timing:
        """Timing of the loop since it started."""
        self._check_alive()
        return self._memory.timing()

    def wait(self) -> None:
        """Returns when the loop has ended, by itself or because the rig was closed."""
        self._loop.wait()

    def close(self) -> None:
        """Brings the reel to rest and ends the loop. May be called again."""
        if self._closed:
            return
        self._closed = True
        with stopped_trial(self._trial, self._stop):
            self._loop.end(self._config.safe.ramp_s + ANSWER_WITHIN_s)

    def _stop(self) -> None:
        self._memory.words[Word.ABORT] = self._number

    def _trial_compensation(
        self, request: TrialRequest
    ) -> tuple[CompensationPlan | None, str] | None:
        """Compensations of a trial; None for the rig's own.

        Raises:
            InvalidInput: the table has mistakes.
        """
        if not request.compensation:
            return None
        return self._compiled(
            table_of(request.compensation, f"compensation of trial {request.trial_id}")
        )

    def _compiled(self, table: CompensationTable | None) -> tuple[CompensationPlan | None, str]:
        """Compensations and their C text, compiled: the loop takes them from the cache."""
        plan = None if table is None else self._config.compensation_plan(table)
        source = self._config.compensation_text(plan)
        make_compensation(plan, source)
        return plan, source

    def _prepare(
        self, request: TrialRequest, compensation: tuple[CompensationPlan | None, str] | None
    ) -> BeginTrial:
        """Writes setpoint and weights to the shared memory."""
        rate = self._config.sampling_Hz
        setpoint = request.profile.setpoint(rate)
        samples = len(setpoint)
        self._memory.setpoint_N[:samples] = setpoint.data
        self._memory.weights[:samples] = self._weights(request, setpoint).data
        self._numbers += 1
        return BeginTrial(
            number=self._numbers,
            coefficients=pidf.coefficients(self._description.controller, request.gains),
            samples=samples,
            open_loop=request.profile.loop == "open",
            cost_max=self._cost_max(request),
            duration_s=samples / rate + self._config.guard.deadline_margin_s,
            compensation=compensation,
        )

    def _weights(self, request: TrialRequest, setpoint_N: FloatArray) -> FloatArray:
        """Weights of the squared error in (35), the running cost of a step."""
        weights = np.zeros(len(setpoint_N))
        step = request.profile
        rate = self._config.sampling_Hz
        if (
            isinstance(step, StepProfile)
            and step.loop == "closed"
            and self._cost.settling_time_s <= step.duration_s - step.step_at_s
            and step.step_N**2 >= TINY  # else nothing can be divided by it
        ):
            shape = step.shape(rate)
            weights[shape.sample :] = self._cost.weights(rate, shape, len(weights))
            weights /= shape.size**2
        return weights

    def _cost_max(self, request: TrialRequest) -> float:
        """Cost at which the guard stops the trial: eta_max times that of the live gains."""
        eta_max, live = self._config.guard.eta_max, self._live_cost
        if eta_max is None or live is None or request.profile != live[0]:
            return math.inf
        return eta_max * live[1]

    def _timeout_s(self, request: TrialRequest) -> float:
        """Longest time from the request of a trial to its answer, s."""
        motion, limits = self._config.motion, self._config.limits
        longest_move_N = limits.tension_max_N - limits.tension_min_N
        return (
            motion.take_up_s
            + abs(longest_move_N) / motion.rate_N_s
            + motion.settle_within_s
            + request.profile.duration_s
            + self._config.guard.deadline_margin_s
            + ANSWER_WITHIN_s
        )

    def _record(self, request: TrialRequest, ended: Ended, begin: BeginTrial) -> TrialRecord:
        columns = self._optional_columns
        if begin.compensation is not None:
            plan, _ = begin.compensation
            columns = plan.columns if plan else ()
        age = 0.0 if math.isnan(ended.first_s) else time.monotonic() - ended.first_s
        self._check_clock()
        started = datetime.fromtimestamp(time.time() - age, UTC)
        return record_of(
            *(request, self._current_description(), ended.outcome, ended.reason),
            started.isoformat(timespec="milliseconds"),
            **self._memory.columns(ended.samples, columns),
        )

    def _check_clock(self) -> None:
        """Logs a jump of the time of day, which dates the records, between trials."""
        day_s, self._day_s = self._day_s, _day_s()
        if abs(self._day_s - day_s) > JUMP_s:
            _log.warning(
                "rig %s: the time of day jumped by %+.3g s since the last trial; the dates of its "
                "records jump with it, the loop has a clock of its own; have NTP slew the clock",
                *(self._description.name, self._day_s - day_s),
            )

    def _current_description(self) -> RigDescription:
        """Description with the present gains and length of a schedule."""
        levels = self._memory.levels
        length, tension = levels[SensorLevels.LENGTH_m], levels[SensorLevels.SCHEDULED_N]
        if self._length_source is None or not length > 0.0:  # a schedule not used yet
            return self._description
        gains = self._length_source.schedule.gains(length, tension)
        return replace(self._description, gains=gains, cable_length_m=length)

    def _learn_cost(self, request: TrialRequest, record: TrialRecord) -> None:
        """Stores the cost of the live gains, the reference of the guard."""
        if request.compensation:
            return
        live = request.gains == self._current_description().gains
        if live and record.outcome is Outcome.DONE:
            error = record.setpoint_N - record.tension_N
            cost = float(self._weights(request, record.setpoint_N) @ (error * error))
            self._live_cost = (request.profile, cost) if cost > 0.0 else None

    def _check_alive(self) -> None:
        if self._closed:
            raise RigError(f"rig {self._description.name} is closed; start a new one")
        self._loop.check()


def _day_s() -> float:
    """Offset of the time of day to the monotonic clock; changes where the day was set."""
    return time.time() - time.monotonic()
