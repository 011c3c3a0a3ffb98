"""A reel on hardware as a rig."""

import logging
import math
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from typing import Self

import numpy as np

from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, RigError
from estune.hardware.config import RigConfig
from estune.hardware.loop_messages import Begin, Done, Ended, ResetEstop, SetLength, SetLiveGains
from estune.hardware.process import ANSWER_WITHIN_s, LoopProcess
from estune.hardware.reel_state_machine import MotionPhase
from estune.hardware.shared_memory import SensorLevels, Word, column, flag_column
from estune.hardware.state import HardwareStatus, Timing
from estune.trial import Outcome, RigDescription, Telemetry, TrialRecord, TrialRequest
from estune.trial.executed_trials import ExecutedTrials, stopped
from estune.trial.profiles import Profile, StepProfile

JUMP_s = 1.0
"""A jump of the time of day between two trials that is worth a word."""

_log = logging.getLogger(__name__)


class HardwareRig:
    """Runs trials on hardware; implements `estune.trial.Rig`. A context manager.

    The loop is a process of its own. The hardware has no power before the first trial; from then
    on the live gains hold it between trials. Safe to be called from several threads: one trial
    runs at a time; `abort` and `estop` may come from anywhere and wait for no other call.

    Attributes:
        notes: What the loop asked the system for and did not get, a line each.
    """

    def __init__(self, config: RigConfig) -> None:
        """Starts the loop.

        Raises:
            InvalidInput: a calibration, or a setting of the driver, cannot be used.
            RigError: the loop does not start, or the driver does not reach its hardware.
        """
        plan = config.plan()
        self._config = config
        self._description = config.describe()
        self._following = plan.following
        self._cost = StepCost(config.settling_time_s)
        self._live_cost: tuple[Profile, float] | None = None
        self._records = ExecutedTrials()
        self._numbers = 0
        self._day_s = _day_s()
        self._trial = threading.Lock()  # held while anything is said to the loop
        self._under_way = 0  # number of the trial the loop was asked for, or zero
        self._shown = ""  # its id
        self._closed = False
        self._loop = LoopProcess(config.name, plan)
        self._memory, self.notes = self._loop.memory, self._loop.notes
        for note in self.notes:
            _log.warning("rig %s: %s", self._description.name, note)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def describe(self) -> RigDescription:
        """What the rig is, and which gains are live now.

        Raises:
            RigError: it is closed, or its loop has ended.
        """
        self._check_alive()
        return self._now()

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: the rig is closed, has stopped itself and not been cleared, its loop has
                failed, or it knows another trial by that id, or no longer its record.
        """
        with self._trial:
            self._check_alive()
            known = self._records.find_record(request)
            if known is not None:
                return known
            self._description.limits.check(request.profile)
            begin = self._prepare(request)
            self._under_way, self._shown = begin.number, request.trial_id
            try:
                answer = self._loop.ask(begin, Ended, self._patience_s(request))
            finally:
                self._under_way, self._shown = 0, ""
            record = self._record(request, answer)
            self._records.add(request, record)
            self._learn_cost(request, record)
            return record

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones, without a jump of the current; a schedule then ends.

        Raises:
            RigError: the rig is closed, its loop has failed, or its emergency stop is on.
        """
        with self._trial:
            self._check_alive()
            if self._memory.words[Word.ESTOP]:
                raise RigError(
                    f"rig {self._description.name} takes no gains: emergency stop "
                    f"({self._memory.order}); look at it, then clear it"
                )
            live = pidf.coefficients(self._description.controller, gains)
            self._loop.ask(SetLiveGains(live), Done, ANSWER_WITHIN_s)
            self._description = replace(self._description, gains=gains)
            self._following = None
            self._live_cost = None

    def tell_length(self, length_m: float) -> None:
        """Says how long the cable is, where no drum angle does; scheduled live gains follow.

        Raises:
            InvalidInput: the length is not finite and above zero, or the rig's file does not say
                that its length is told.
            RigError: the rig is closed, or its loop has failed.
        """
        if not (math.isfinite(length_m) and length_m > 0.0):
            raise InvalidInput(f"cable length is {length_m} m; it must be finite and above zero")
        schedule = self._config.schedule
        if schedule is None or schedule.length != "told":
            raise InvalidInput(
                f'rig {self._description.name} is not told its length; say length = "told" in '
                "the [schedule] of its file"
            )
        with self._trial:
            self._check_alive()
            self._loop.ask(SetLength(length_m), Done, ANSWER_WITHIN_s)

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        self._check_alive()
        with stopped(self._trial, self._stop):
            return self.describe()

    def estop(self, reason: str) -> None:
        """Emergency stop: brings the reel to rest from the next sample on, whatever it does.

        Returns at once. The rig takes neither trials nor gains until it is cleared. It is
        software: a reel that can hurt anybody needs a stop that cuts the amplifier's power too.
        """
        self._check_alive()
        self._memory.order = reason or "no reason given"
        self._memory.words[Word.ESTOP] = 1

    def clear(self) -> None:
        """Lets a rig that was stopped, by itself or by hand, take trials again.

        Raises:
            RigError: the rig is closed, or its loop has failed.
        """
        with self._trial:
            self._check_alive()
            self._memory.words[Word.ESTOP] = 0
            self._loop.ask(ResetEstop(), Done, ANSWER_WITHIN_s)

    def telemetry(self, after: int) -> Telemetry | None:
        """The samples of the trial under way from index `after` on; None if none is."""
        trial_id, words = self._shown, self._memory.words
        measured = words[Word.PROGRESS]
        if not trial_id or words[Word.PHASE] != MotionPhase.TRIAL:
            return None
        memory, first = self._memory, min(after, measured)
        columns = (
            np.array(source[first:measured], np.float64)
            for source in (
                *(memory.setpoint_N, memory.tension_N, memory.current_A, memory.angle_rad),
            )
        )
        return Telemetry(trial_id, first, self._config.sampling_Hz, *columns)

    def state(self) -> HardwareStatus:
        """How the rig stands now."""
        self._check_alive()
        return HardwareStatus.of(self._memory)

    def timing(self) -> Timing:
        """How the loop has kept its time."""
        self._check_alive()
        return Timing.of(self._memory)

    def wait(self) -> None:
        """Returns when the loop has ended, by itself or because the rig was closed."""
        self._loop.process.wait()

    def close(self) -> None:
        """Brings the reel to rest and ends the loop. May be called again."""
        if self._closed:
            return
        self._closed = True
        with stopped(self._trial, self._stop):
            self._loop.end(self._config.safe.ramp_s + ANSWER_WITHIN_s)

    def _stop(self) -> None:
        self._memory.words[Word.ABORT] = self._under_way

    def _prepare(self, request: TrialRequest) -> Begin:
        """Puts what is to be followed where the loop finds it."""
        rate = self._config.sampling_Hz
        setpoint = request.profile.setpoint(rate)
        samples = len(setpoint)
        self._memory.setpoint_N[:samples] = setpoint.data
        self._memory.weights[:samples] = self._weights(request, setpoint).data
        self._numbers += 1
        return Begin(
            number=self._numbers,
            coefficients=pidf.coefficients(self._description.controller, request.gains),
            samples=samples,
            open_loop=request.profile.loop == "open",
            cost_max=self._cost_max(request),
            duration_s=samples / rate + self._config.guard.deadline_margin_s,
        )

    def _weights(self, request: TrialRequest, setpoint_N: FloatArray) -> FloatArray:
        """Weights of the squared error in (35), the cost that a step runs up sample by sample."""
        weights = np.zeros(len(setpoint_N))
        step = request.profile
        rate = self._config.sampling_Hz
        if (
            isinstance(step, StepProfile)
            and step.loop == "closed"
            and self._cost.settling_time_s <= step.duration_s - step.step_at_s
        ):
            index = step.step_index(rate)
            weights[index:] = self._cost.weights(rate, len(weights) - index)
            weights /= step.step_N**2
        return weights

    def _cost_max(self, request: TrialRequest) -> float:
        """The cost at which the guard stops the trial: eta_max times that of the live gains."""
        eta_max, known = self._config.guard.eta_max, self._live_cost
        if eta_max is None or known is None or request.profile != known[0]:
            return math.inf
        return eta_max * known[1]

    def _patience_s(self, request: TrialRequest) -> float:
        """How long a trial may take from being asked for to its answer, s."""
        motion, limits = self._config.motion, self._config.limits
        way = limits.tension_max_N - limits.tension_min_N
        return (
            motion.take_up_s
            + abs(way) / motion.rate_N_s
            + motion.settle_within_s
            + request.profile.duration_s
            + self._config.guard.deadline_margin_s
            + ANSWER_WITHIN_s
        )

    def _record(self, request: TrialRequest, ended: Ended) -> TrialRecord:
        """The record of what is in the shared memory."""
        memory, kept = self._memory, ended.kept
        age = 0.0 if math.isnan(ended.first_s) else time.monotonic() - ended.first_s
        self._look_at_clock()
        started = datetime.fromtimestamp(time.time() - age, UTC)
        columns = [
            column(source, kept)
            for source in (
                *(memory.time_s, memory.setpoint_N, memory.tension_N),
                *(memory.current_A, memory.angle_rad),
            )
        ]
        flags = flag_column(memory.flags, kept)
        for array in columns:
            array.flags.writeable = False  # it may be handed out again
        flags.flags.writeable = False
        time_s, setpoint, tension, current, angle = columns
        return TrialRecord(
            trial_id=request.trial_id,
            rig=self._description.name,
            sampling_Hz=self._config.sampling_Hz,
            cable_length_m=self._now().cable_length_m,
            preload_N=request.profile.preload_N,
            gains=request.gains,
            outcome=ended.outcome,
            reason=ended.sentence,
            started_at=started.isoformat(timespec="milliseconds"),
            software=self._description.software,
            time_s=time_s,
            setpoint_N=setpoint,
            tension_N=tension,
            current_A=current,
            angle_rad=angle,
            flags=flags,
            loop=request.profile.loop,
            profile=request.profile.kind,
        )

    def _look_at_clock(self) -> None:
        """Says so where the time of day, which dates the records, has jumped between trials."""
        day_s, self._day_s = self._day_s, _day_s()
        if abs(self._day_s - day_s) > JUMP_s:
            _log.warning(
                "rig %s: the time of day jumped by %+.3g s since the last trial; its records are "
                "dated by the new one, and the loop, which keeps another clock, has not noticed: "
                "have the clock kept by NTP, which slews it",
                *(self._description.name, self._day_s - day_s),
            )

    def _now(self) -> RigDescription:
        """The description, with the gains and the length that a schedule has come to."""
        levels = self._memory.levels
        length, tension = levels[SensorLevels.LENGTH_m], levels[SensorLevels.SCHEDULED_N]
        if self._following is None or not length > 0.0:  # it has not begun to follow
            return self._description
        gains = self._following.schedule.gains(length, tension)
        return replace(self._description, gains=gains, cable_length_m=length)

    def _learn_cost(self, request: TrialRequest, record: TrialRecord) -> None:
        """Takes note of the cost of the live gains, which the guard holds others to."""
        live = request.gains == self._now().gains
        if live and record.outcome is Outcome.DONE:
            error = record.setpoint_N - record.tension_N
            cost = float(self._weights(request, record.setpoint_N) @ (error * error))
            self._live_cost = (request.profile, cost) if cost > 0.0 else None

    def _check_alive(self) -> None:
        if self._closed:
            raise RigError(f"rig {self._description.name} is closed; make a new one")
        self._loop.check()


def _day_s() -> float:
    """The time of day by the clock that never steps; changes only where it was set."""
    return time.time() - time.monotonic()
