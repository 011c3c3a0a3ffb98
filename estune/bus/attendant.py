"""Stands between the link and a rig: takes trials in, runs them one at a time, remembers them.

The thread that brings a trial in runs it; for as long as it does, another must be there to bring
the next question. Every question is answered within milliseconds, with one exception that saves a
quick rig half of its overhead: if the last trial took less than `PROMPT_S`, as a simulated one
does, this one's record is awaited and is itself the answer to the submit. Should it take longer
after all, the client asks again, is told by the other thread, and nothing is lost.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from queue import SimpleQueue

import numpy as np

from estune import frame
from estune.bus.ledger import Ledger
from estune.errors import EstuneError, InvalidInput, RigError
from estune.protocol import Answer, Cancel, SetGains, Status, Submit, check_name, refusal
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest

PROMPT_S = 0.01
CLOSE_WITHIN_S = 10.0
_ABORT_AGAIN_S = 0.05
_RIG_WITHIN_S = 0.2

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Trial:
    """The trial under way."""

    request: TrialRequest
    polled: bool = False  # somebody was told that it has not ended yet
    cancelled: bool = False
    abort_failed: EstuneError | None = None


class Attendant:
    """Answers for one rig. Knows nothing of the transport; may be called from any thread."""

    def __init__(self, rig: Rig, changed: Callable[[], None]) -> None:
        """Begins to attend.

        Args:
            rig: The rig. It is called by one thread at a time, not always the same; `abort` by
                another.
            changed: Called when a trial has ended and somebody was told before that it had not.
        """
        self._rig = rig
        self._changed = changed
        self._ledger = Ledger()
        self._lock = threading.Condition()  # guards the ledger and the four below
        self._trial: _Trial | None = None
        self._prompt = False
        self._ended = 0
        self._closing = False
        self._description = rig.describe()
        self._rig_free = threading.Lock()
        self._stopping: SimpleQueue[_Trial | None] = SimpleQueue()
        # Ready from the start: no thread can be made while the interpreter shuts down. A daemon:
        # a rig that will not stop must not keep the process from ending.
        threading.Thread(target=self._stop_trials, name="aborts", daemon=True).start()

    def submit(self, command: Submit, answer: Callable[[Answer | bytes], None]) -> None:
        """Takes a trial in, unless it has been before, and runs it.

        Args:
            command: The trial.
            answer: Called once, with the record in a frame if it is at hand, else with why there
                is none (yet). Must not raise.
        """
        with self._lock:
            found = self._find(command.request.trial_id, command.digest)
            taken = found or self._take_in(command)
            prompt = self._prompt
        if not isinstance(taken, _Trial):
            answer(taken)
            return
        if not prompt:
            taken.polled = True
            answer(Answer("accepted", command.request.trial_id))
        result = self._perform(taken)
        if prompt:
            answer(result)
        if taken.polled:
            self._changed()

    def result(self, trial_id: str, request_digest: str) -> Answer | bytes:
        """The state of a trial: its record in a frame once it has ended."""
        with self._lock:
            return self._find(trial_id, request_digest) or Answer("unknown", trial_id)

    def cancel(self, command: Cancel) -> Answer:
        """Has the trial under way stopped. The answer names it until the live gains are back."""
        with self._lock:
            trial = self._trial
            if trial is None or command.trial_id not in ("", trial.request.trial_id):
                return Answer("accepted")
            failed, trial.abort_failed = trial.abort_failed, None
            if failed is not None:
                trial.cancelled = False
                return refusal(failed, trial.request.trial_id)
            if not trial.cancelled:
                trial.cancelled = True
                self._stopping.put(trial)
        return Answer("accepted", trial.request.trial_id)

    def set_gains(self, command: SetGains) -> Answer:
        """Makes gains the live ones, unless a trial is under way."""
        with self._lock:
            if self._trial is not None:
                return self._busy(self._trial)
        if not self._rig_free.acquire(timeout=_RIG_WITHIN_S):
            return refusal(RigError("the rig is occupied; try again"))
        try:
            self._rig.apply(command.gains)
            self._description = self._rig.describe()
        except EstuneError as error:
            return refusal(error)
        finally:
            self._rig_free.release()
        return Answer("accepted")

    def status(self) -> Status:
        """What the rig does now."""
        with self._lock:
            return Status("" if self._trial is None else self._trial.request.trial_id, self._ended)

    def describe(self) -> RigDescription:
        """What the rig is; while a trial is under way, as it was before."""
        if self._rig_free.acquire(blocking=False):
            try:
                self._description = self._rig.describe()
            finally:
                self._rig_free.release()
        return self._description

    def close(self) -> None:
        """Stops the trial under way, and returns once the live gains are back."""
        with self._lock:
            self._closing = True
        self.cancel(Cancel())
        self._stopping.put(None)
        with self._lock:
            ended = self._lock.wait_for(lambda: self._trial is None, CLOSE_WITHIN_S)
        if not ended:
            _log.error("the trial under way has not stopped within %g s", CLOSE_WITHIN_S)

    def _find(self, trial_id: str, request_digest: str) -> Answer | bytes | None:
        """The state of a trial, None if it was never taken in. The lock is held."""
        found = self._ledger.find(trial_id, request_digest)
        if isinstance(found, Answer) and found.verdict == "known" and self._trial is not None:
            self._trial.polled = True
        return found

    def _take_in(self, command: Submit) -> "_Trial | Answer":
        """Notes a new trial as the one under way, or says why not. The lock is held."""
        request = command.request
        if self._closing:
            return refusal(RigError("the rig is being shut down"))
        if self._trial is not None:
            return self._busy(self._trial)
        try:
            self._check(request)
        except InvalidInput as error:
            return refusal(error)
        self._ledger.add(request.trial_id, command.digest)
        self._trial = _Trial(request)
        return self._trial

    def _check(self, request: TrialRequest) -> None:
        check_name("trial id", request.trial_id)
        self._description.limits.check(request.step)
        samples = request.step.samples(self._description.controller.sampling_Hz)
        if frame.size(samples, reference=True) > frame.MAX_BYTES:
            raise InvalidInput(
                f"a trial of {samples} samples does not fit into a record of {frame.MAX_BYTES} "
                "bytes; ask for a shorter one"
            )

    def _busy(self, trial: _Trial) -> Answer:
        name, trial_id = self._description.name, trial.request.trial_id
        sentence = (
            f"rig {name!r} is busy with trial {trial_id}; wait until it has ended, or stop it"
        )
        return Answer("busy", trial_id, RigError.__name__, sentence)

    def _perform(self, trial: _Trial) -> Answer | bytes:
        """Runs the trial under way, and notes what came of it."""
        began = time.monotonic()
        result = self._run(trial)
        ran = isinstance(result, bytes) and not trial.cancelled
        with self._lock:
            self._ledger.end(trial.request.trial_id, result)
            self._ended += 1
            self._trial = None
            self._prompt = ran and time.monotonic() - began < PROMPT_S
            self._lock.notify_all()
        return result

    def _run(self, trial: _Trial) -> Answer | bytes:
        trial_id = trial.request.trial_id
        try:
            with self._rig_free:
                if trial.cancelled:
                    return frame.encode(_never_begun(trial.request, self._description))
                return frame.encode(self._rig.run(trial.request))
        except BaseException as error:  # noqa: BLE001  even SystemExit: somebody waits for the trial
            return refusal(named(error, f"trial {trial_id}"), trial_id)

    def _stop_trials(self) -> None:
        while (trial := self._stopping.get()) is not None:
            ended = False
            while not ended:  # again and again: the first call may come before the trial begins
                try:
                    self._rig.abort()
                except BaseException as error:  # noqa: BLE001  as above
                    trial.abort_failed = named(error, "stopping the trial")
                    break
                with self._lock:
                    ended = self._lock.wait_for(partial(self._has_ended, trial), _ABORT_AGAIN_S)

    def _has_ended(self, trial: _Trial) -> bool:
        return self._trial is not trial


def named(error: BaseException, doing: str) -> EstuneError:
    """An error of the tree for whatever a rig has raised; the trace of a stranger is logged."""
    if isinstance(error, EstuneError):
        return error
    _log.error("the rig failed in %s", doing, exc_info=error)
    return RigError(
        f"the rig's own program failed in {doing}: {type(error).__name__}: {error}; "
        "the trace is in its log"
    )


def _never_begun(request: TrialRequest, rig: RigDescription) -> TrialRecord:
    """The record of a trial that was stopped before it began: no samples, the live gains."""
    nothing = np.empty(0)
    return TrialRecord(
        trial_id=request.trial_id,
        rig=rig.name,
        sampling_Hz=rig.controller.sampling_Hz,
        cable_length_m=rig.cable_length_m,
        preload_N=request.step.preload_N,
        gains=rig.gains,
        outcome=Outcome.CANCELLED,
        reason="stopped before it began",
        started_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        software=rig.software,
        time_s=nothing,
        setpoint_N=nothing,
        tension_N=nothing,
        current_A=nothing,
        angle_rad=nothing,
        flags=np.empty(0, np.uint8),
    )
