"""A reel on hardware as a rig."""

import contextlib
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from estune import errors
from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.errors import EstuneError, InvalidInput, RigError
from estune.hardware.config import RigConfig
from estune.hardware.machine import Phase
from estune.hardware.memory import BIN_s, Level, Memory, Word, column, flag_column, make_file
from estune.hardware.plan import (
    Begin,
    Clear,
    Done,
    End,
    Ended,
    Failed,
    Plan,
    Ready,
    Refused,
    Swap,
    Tell,
)
from estune.profiles import Profile, StepProfile
from estune.trial import (
    FloatArray,
    Outcome,
    RigDescription,
    Telemetry,
    TrialRecord,
    TrialRequest,
)

BEAT_s = 0.02
"""How often the rig gives its loop a sign of life."""

REMEMBERED = 64
"""Records kept for a trial that is asked for again; of older ones only the ids are."""

JUMP_s = 1.0
"""A jump of the time of day between two trials that is worth a word."""

_START_WITHIN_s = 30.0
_ANSWER_WITHIN_s = 2.0
_STALLED_s = 1.0
_POLL_s = 0.05

_log = logging.getLogger(__name__)
_Answer = TypeVar("_Answer")


class RigState(NamedTuple):
    """How a rig stands.

    Attributes:
        phase: What its loop does, as a word: off, take_up, hold, trial, ramp, stopped.
        reason: Why it last stopped; empty where it did not, or was cleared.
        latched: Whether it takes no trial until it is cleared.
        tension_N: Tension read last.
        setpoint_N: Setpoint between trials.
        current_A: Current commanded last.
        angle_rad: Angle read last.
    """

    phase: str
    reason: str
    latched: bool
    tension_N: float
    setpoint_N: float
    current_A: float
    angle_rad: float


class Timing(NamedTuple):
    """How the loop has kept its time since it started.

    Attributes:
        samples: How many it has run.
        late: How many of them began late.
        missed: Sampling instants passed over altogether.
        bin_s: Width of a bin of the histograms; the last holds all that was longer.
        lateness: Samples by how long after its instant they began.
        turnaround: Samples by how long after its instant the current was commanded.
    """

    samples: int
    late: int
    missed: int
    bin_s: float
    lateness: NDArray[np.int64]
    turnaround: NDArray[np.int64]

    def since(self, earlier: "Timing") -> "Timing":
        """The same from an earlier look on."""
        return Timing(
            self.samples - earlier.samples,
            self.late - earlier.late,
            self.missed - earlier.missed,
            self.bin_s,
            self.lateness - earlier.lateness,
            self.turnaround - earlier.turnaround,
        )


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
        self._records: OrderedDict[str, tuple[TrialRequest, TrialRecord | None]] = OrderedDict()
        self._numbers = 0
        self._day_s = _day_s()
        self._trial = threading.Lock()  # held while anything is said to the loop
        self._under_way = 0  # number of the trial the loop was asked for, or zero
        self._shown = ""  # its id
        self._closed = False
        self._failure = ""
        file = make_file(plan.capacity)
        try:
            self._memory = Memory(file, plan.capacity)
            self._loop, self._process = _start(file)
        finally:
            os.close(file)
        self._beating = threading.Event()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        try:
            self.notes = self._introduce(plan)
        except BaseException:
            self._kill()
            raise
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
            if request.trial_id in self._records:
                return self._again(request)
            self._description.limits.check(request.profile)
            begin = self._prepare(request)
            self._under_way, self._shown = begin.number, request.trial_id
            try:
                answer = self._ask(begin, Ended, self._patience_s(request))
            finally:
                self._under_way, self._shown = 0, ""
            record = self._record(request, answer)
            self._remember(request, record)
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
            self._ask(Swap(live), Done, _ANSWER_WITHIN_s)
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
            self._ask(Tell(length_m), Done, _ANSWER_WITHIN_s)

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        self._check_alive()
        with self._stopped():
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
            self._ask(Clear(), Done, _ANSWER_WITHIN_s)

    def telemetry(self, after: int) -> Telemetry | None:
        """The samples of the trial under way from index `after` on; None if none is."""
        trial_id, words = self._shown, self._memory.words
        measured = words[Word.PROGRESS]
        if not trial_id or words[Word.PHASE] != Phase.TRIAL:
            return None
        memory, first = self._memory, min(after, measured)
        columns = (
            np.array(source[first:measured], np.float64)
            for source in (
                *(memory.setpoint_N, memory.tension_N, memory.current_A, memory.angle_rad),
            )
        )
        return Telemetry(trial_id, first, self._config.sampling_Hz, *columns)

    def state(self) -> RigState:
        """How the rig stands now."""
        self._check_alive()
        words, levels = self._memory.words, self._memory.levels
        return RigState(
            phase=Phase(words[Word.PHASE]).name.lower(),
            reason=self._memory.reason,
            latched=bool(words[Word.LATCHED] or words[Word.ESTOP]),
            tension_N=levels[Level.TENSION_N],
            setpoint_N=levels[Level.SETPOINT_N],
            current_A=levels[Level.CURRENT_A],
            angle_rad=levels[Level.ANGLE_rad],
        )

    def timing(self) -> Timing:
        """How the loop has kept its time."""
        self._check_alive()
        words = self._memory.words
        return Timing(
            words[Word.SAMPLES],
            words[Word.LATE],
            words[Word.MISSED],
            BIN_s,
            np.array(self._memory.lateness),
            np.array(self._memory.turnaround),
        )

    def wait(self) -> None:
        """Returns when the loop has ended, by itself or because the rig was closed."""
        self._process.wait()

    def close(self) -> None:
        """Brings the reel to rest and ends the loop. May be called again."""
        if self._closed:
            return
        self._closed = True
        with self._stopped():
            try:
                self._loop.send(End())
                self._process.wait(self._config.safe.ramp_s + _ANSWER_WITHIN_s)
            except (OSError, subprocess.TimeoutExpired) as error:
                why = self._memory.reason or error
                name = self._description.name
                _log.error("rig %s: its loop did not end in order: %s", name, why)
            self._kill()

    @contextlib.contextmanager
    def _stopped(self) -> Iterator[None]:
        """Holds the lock, having stopped whatever trial stood in the way.

        Said again and again: a trial that is being prepared has no number to be stopped by yet.
        """
        stopped = False
        while not stopped:
            self._memory.words[Word.ABORT] = self._under_way
            stopped = self._trial.acquire(timeout=_POLL_s)
        try:
            yield
        finally:
            self._trial.release()

    def _introduce(self, plan: Plan) -> tuple[str, ...]:
        """Tells the loop its plan and waits until it runs."""
        with contextlib.suppress(OSError):  # it has ended at once; it says why below
            self._loop.send(plan)
        return self._await(Ready, _START_WITHIN_s).notes

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
            + _ANSWER_WITHIN_s
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
        length, tension = levels[Level.LENGTH_m], levels[Level.SCHEDULED_N]
        if self._following is None or not length > 0.0:  # it has not begun to follow
            return self._description
        gains = self._following.schedule.gains(length, tension)
        return replace(self._description, gains=gains, cable_length_m=length)

    def _remember(self, request: TrialRequest, record: TrialRecord) -> None:
        self._records[request.trial_id] = request, record
        if len(self._records) > REMEMBERED:
            oldest = list(self._records)[-REMEMBERED - 1]
            self._records[oldest] = self._records[oldest][0], None
        live = request.gains == self._now().gains
        if live and record.outcome is Outcome.DONE:
            error = record.setpoint_N - record.tension_N
            cost = float(self._weights(request, record.setpoint_N) @ (error * error))
            self._live_cost = (request.profile, cost) if cost > 0.0 else None

    def _again(self, request: TrialRequest) -> TrialRecord:
        """The record of a trial that has run before."""
        asked, record = self._records[request.trial_id]
        if request != asked:
            raise RigError(
                f"trial {request.trial_id} has run with other gains or another profile; "
                "a trial id is used once: ask under a new run name or attempt"
            )
        if record is None:
            raise RigError(
                f"trial {request.trial_id} has run, but the rig no longer holds its record; "
                "ask under another number or attempt"
            )
        return record

    def _ask(self, command: object, kind: type[_Answer], within_s: float) -> _Answer:
        """Has the loop do something. The lock is held."""
        try:
            self._loop.send(command)
        except OSError as error:
            raise self._failed(f"its loop has ended: {error}") from error
        return self._await(kind, within_s)

    def _await(self, kind: type[_Answer], within_s: float) -> _Answer:
        """What the loop answers.

        Raises:
            RigError: it does not answer, or refuses.
            EstuneError: it failed, by its own account.
        """
        deadline = time.monotonic() + within_s
        samples, seen_at = -1, time.monotonic()
        try:
            while not self._loop.poll(_POLL_s):
                now = time.monotonic()
                if self._memory.words[Word.SAMPLES] != samples:
                    samples, seen_at = self._memory.words[Word.SAMPLES], now
                stalled = samples > 0 and now - seen_at > _STALLED_s
                if stalled or now > deadline:
                    doing = "has stood still" if stalled else "has not answered"
                    waited = now - seen_at if stalled else within_s
                    raise self._failed(f"its loop {doing} for {waited:.1f} s")
            answer = self._loop.recv()
        except (EOFError, OSError) as error:
            code = self._process.wait()
            raise self._failed(f"its loop has ended by itself, exit code {code}") from error
        if isinstance(answer, Failed):
            self._failed(answer.sentence)
            raise _error(answer)
        if isinstance(answer, Refused):
            raise RigError(f"rig {self._description.name} takes no trial: {answer.sentence}")
        if not isinstance(answer, kind):
            raise self._failed(f"its loop has answered out of turn: {answer}")
        return answer

    def _failed(self, sentence: str) -> RigError:
        """Gives the loop up for good: what is left to the hardware is its own watchdog.

        A loop that has merely stood still must not come to life again with an old command.
        """
        self._failure = sentence
        self._kill()
        return RigError(
            f"rig {self._description.name}: {sentence}; look at it, then start it anew"
        )

    def _kill(self) -> None:
        self._beating.set()
        self._process.kill()
        self._process.wait()
        self._loop.close()

    def _check_alive(self) -> None:
        name = self._description.name
        if self._closed:
            raise RigError(f"rig {name} is closed; make a new one")
        if not self._failure and self._process.poll() is not None:
            code, why = self._process.returncode, self._memory.reason or "it has not said why"
            self._failure = f"its loop has ended, exit code {code}: {why}"
        if self._failure:
            raise RigError(f"rig {name}: {self._failure}; look at it, then start it anew")

    def _beat(self) -> None:
        words = self._memory.words
        while not self._beating.wait(BEAT_s):
            words[Word.BEAT] += 1


def _start(file: int) -> tuple["Connection[Any, Any]", "subprocess.Popen[bytes]"]:
    """Starts the loop's process: never by a fork, for Zenoh does not survive one."""
    ours, theirs = Pipe()
    with theirs:
        process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            [sys.executable, "-m", "estune.hardware.loop", str(theirs.fileno()), str(file)],
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(), file),
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # threads, and their memory locked
            start_new_session=True,  # Ctrl-C is for us; the loop ends when we do
        )
    return ours, process


def _day_s() -> float:
    """The time of day by the clock that never steps; changes only where it was set."""
    return time.time() - time.monotonic()


def _error(failed: Failed) -> EstuneError:
    kind = getattr(errors, failed.error, RigError)
    made: EstuneError = kind(failed.sentence)
    return made
