"""Stands between the link and a rig: takes trials in, has them run one at a time, remembers them.

Every answer is given within milliseconds; the trials run in a thread of their own. A trial that
ends within `PROMPT_S` is answered with its record at once, as a simulated rig's usually are.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from queue import SimpleQueue

import numpy as np

from estune import frame
from estune.bus.ledger import Ledger
from estune.errors import EstuneError, InvalidInput, RigError
from estune.protocol import Answer, Cancel, SetGains, Status, Submit, check_name, digest, refusal
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest

PROMPT_S = 0.002
CLOSE_WITHIN_S = 10.0
_ABORT_AGAIN_S = 0.05
_RIG_WITHIN_S = 0.2

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Trial:
    """The trial under way."""

    request: TrialRequest
    cancelled: bool = False
    abort_failed: EstuneError | None = None
    ended: threading.Event = field(default_factory=threading.Event)


class Attendant:
    """Answers for one rig. Knows nothing of the transport; may be called from any thread."""

    def __init__(self, rig: Rig, changed: Callable[[], None]) -> None:
        """Begins to attend.

        Args:
            rig: The rig. It is called from one thread at a time, but for `abort`.
            changed: Called, from the trials' thread, when a trial has ended.
        """
        self._rig = rig
        self._changed = changed
        self._ledger = Ledger()
        self._lock = threading.Lock()  # guards the ledger and the four below
        self._trial: _Trial | None = None
        self._ended = 0
        self._closing = False
        self._description = rig.describe()
        self._rig_free = threading.Lock()
        self._waiting: SimpleQueue[_Trial | None] = SimpleQueue()
        self._stopping: SimpleQueue[_Trial | None] = SimpleQueue()
        # Daemons: a trial that will not end must not keep the process from ending. Both stand
        # ready from the start, since no thread can be made while the interpreter shuts down.
        self._runner = threading.Thread(target=self._run_trials, name="trials", daemon=True)
        self._stopper = threading.Thread(target=self._stop_trials, name="aborts", daemon=True)
        self._runner.start()
        self._stopper.start()

    def submit(self, command: Submit) -> Answer | bytes:
        """Takes a trial in, unless it has been before; the record if it has ended by then."""
        request = command.request
        if digest(request) != command.digest:
            return refusal(RigError(f"trial {request.trial_id}: digest and request do not agree"))
        with self._lock:
            state = self._ledger.find(request.trial_id, command.digest)
            if state is None:
                state = self._take_in(request)
            trial = self._trial
        if trial and trial.request == request and trial.ended.wait(PROMPT_S):
            return self.result(request.trial_id, command.digest)
        return state

    def result(self, trial_id: str, request_digest: str) -> Answer | bytes:
        """The state of a trial: its record in a frame once it has ended."""
        with self._lock:
            return self._ledger.find(trial_id, request_digest) or Answer("unknown", trial_id)

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
            already, self._closing = self._closing, True
        if already:
            return
        self.cancel(Cancel())
        self._waiting.put(None)
        self._stopping.put(None)
        self._runner.join(CLOSE_WITHIN_S)
        if self._runner.is_alive():
            _log.error("the trial under way has not stopped within %g s", CLOSE_WITHIN_S)

    def _take_in(self, request: TrialRequest) -> Answer:
        """Queues a new trial. The lock is held."""
        if self._closing:
            return refusal(RigError("the rig is being shut down"))
        if self._trial is not None:
            return self._busy(self._trial)
        try:
            self._check(request)
        except InvalidInput as error:
            return refusal(error)
        self._ledger.add(request.trial_id, digest(request))
        self._trial = _Trial(request)
        self._waiting.put(self._trial)
        return Answer("accepted", request.trial_id)

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

    def _run_trials(self) -> None:
        while (trial := self._waiting.get()) is not None:
            result = self._run(trial)
            with self._lock:
                self._ledger.end(trial.request.trial_id, result)
                self._ended += 1
                self._trial = None
            trial.ended.set()
            self._changed()

    def _run(self, trial: _Trial) -> Answer | bytes:
        trial_id = trial.request.trial_id
        try:
            with self._rig_free:
                if trial.cancelled:
                    return frame.encode(_never_begun(trial.request, self._description))
                return frame.encode(self._rig.run(trial.request))
        except Exception as error:  # noqa: BLE001  what a rig raises must reach the one who waits
            return refusal(named(error, f"trial {trial_id}"), trial_id)

    def _stop_trials(self) -> None:
        while (trial := self._stopping.get()) is not None:
            # Again and again: the first call may come before the trial has begun.
            while not trial.ended.is_set():
                try:
                    self._rig.abort()
                except Exception as error:  # noqa: BLE001  as above
                    trial.abort_failed = named(error, "stopping the trial")
                    break
                trial.ended.wait(_ABORT_AGAIN_S)


def named(error: Exception, doing: str) -> EstuneError:
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
