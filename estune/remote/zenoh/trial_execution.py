"""Execution of trials on a rig: protocol state, active trial and the rig itself, thread-safe.

Two threads guarantee that a trial ends: one stops it on order, the other is the dead-man's switch.
The lock of the state is never held while anything is written or moves, so that neither a slow disk
nor a slow rig delays a renewal or an emergency stop.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from queue import SimpleQueue

from estune.core.gains import Gains
from estune.errors import EstuneError, InvalidInput, ProtocolError, RigError
from estune.remote.ledger import Ledger, LedgerEntry
from estune.remote.messages import Answer, check_name, refusal
from estune.remote.state_machine import events
from estune.remote.state_machine import rig as machine
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import RigState, Transition
from estune.remote.state_machine.trials import TrialEvent, TrialState
from estune.trial import (
    OPTIONAL_COLUMNS,
    CompensatedRig,
    Feedback,
    Outcome,
    Rig,
    RigDescription,
    Setpoint,
    SetpointFollower,
    TrialRecord,
    TrialRequest,
    empty_record,
    record_frame,
)

_ABORT_AGAIN_S = 0.05  # a trial that is just beginning may miss the first
_RIG_WITHIN_S = 0.2  # below the client's timeout: it hears "occupied", not silence

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class ActiveTrial:
    """The active trial; `stop_error` is the rig's error on the order to stop, until reported."""

    request: TrialRequest
    digest: str
    is_stopping: bool = False
    stop_error: EstuneError | None = None


class SharedRigState:
    """Protocol state and active trial behind one lock, and the threads that end them.

    Attributes:
        lock: Guards the two below.
    """

    def __init__(self, rig: Rig, latched: str, changed: Callable[[], None]) -> None:
        """Starts without a trial; only the rig's `abort` is called."""
        self.lock = threading.Lock()
        self.state = RigState(latched=latched)
        self.trial: ActiveTrial | None = None
        self.estop_under_way = ""  # its reason, from before the rig is called to the event
        self._rig = rig
        self._changed = changed
        self._ended = threading.Condition(self.lock)
        self._leased = threading.Condition(self.lock)
        self._stopping: SimpleQueue[ActiveTrial | None] = SimpleQueue()
        # Started at once: no thread can be started while the interpreter shuts down. Daemons: a
        # rig that does not stop must not keep the process from ending.
        for name, work in (("aborts", self._stop_trials), ("lease", self._watch_lease)):
            threading.Thread(target=work, name=name, daemon=True).start()

    def step(self, event: events.Event, now_s: float) -> Transition:
        """Applies an event, and has the trial stopped if that is ordered. The lock is held."""
        before = self.state
        move = machine.step(before, event, now_s)
        self.state = move.state
        trial = self.trial
        if RigAction.STOP in move.orders and trial is not None and not trial.is_stopping:
            trial.is_stopping = True
            self._stopping.put(trial)
        if isinstance(event, events.Acquire | events.Close):
            self._leased.notify_all()
        if move.state is not before and not isinstance(event, events.Renew):
            self._changed()
        return move

    def apply_event(self, event: events.Event) -> Transition:
        """Applies an event of this moment."""
        now_s = time.monotonic()  # before the lock: a renewal counts from its arrival
        with self.lock:
            return self.step(event, now_s)

    def may_begin(self) -> bool:
        """Whether the active trial may move the rig."""
        return self.apply_event(events.Begin()).reply_code is ReplyCode.ACCEPTED

    def finish_trial(self) -> None:
        """Ends the active trial, once the live gains are restored."""
        with self.lock:
            self.step(events.End(), time.monotonic())
            self.trial = None
            self._ended.notify_all()

    def stop_reason(self) -> str:
        """Reason why the active trial is being stopped; empty if it is not."""
        with self.lock:
            stopping = "" if self.state.trial is None else self.state.trial.stopping
            # The rig is stopped before the event is applied, and its trial may end in between.
            return stopping or self.estop_under_way

    def close(self, within_s: float) -> bool:
        """Stops the active trial; returns whether it has ended in time."""
        self.apply_event(events.Close())
        self._stopping.put(None)
        with self.lock:
            return self._ended.wait_for(lambda: self.trial is None, within_s)

    def _stop_trials(self) -> None:
        while (trial := self._stopping.get()) is not None:
            ended = False
            while not ended:  # repeatedly: the first call may precede the start of the trial
                try:
                    self._rig.abort()
                except BaseException as error:  # noqa: BLE001  even SystemExit: the stop must hold
                    if trial.stop_error is None:
                        trial.stop_error = to_estune_error(error, "stopping the trial")
                with self.lock:
                    ended = self._ended.wait_for(partial(self._has_ended, trial), _ABORT_AGAIN_S)

    def _has_ended(self, trial: ActiveTrial) -> bool:
        return self.trial is not trial

    def _watch_lease(self) -> None:
        """The dead-man's switch: ends a lease that is not renewed."""
        with self.lock:
            while not self.state.closed:
                lease, now_s = self.state.lease, time.monotonic()
                if lease is None:
                    self._leased.wait()
                elif now_s < lease.expires_at_s:
                    self._leased.wait(lease.expires_at_s - now_s)
                else:
                    _log.warning("the lease of %s expired", lease.holder)
                    self.step(events.Expire(), now_s)


class TrialExecutor:
    """Exclusive access to a rig: one trial, change of gains or description at a time.

    Attributes:
        description: The rig at rest, as last described.
    """

    def __init__(
        self, rig: Rig, ledger: Ledger, shared: SharedRigState, description: RigDescription
    ) -> None:
        self.description = description
        self._rig = rig
        self._ledger = ledger
        self._shared = shared
        self._rig_free = threading.Lock()

    def describe(self) -> RigDescription:
        """Current description; during a trial that of the rig before it."""
        # A description must not wait for a trial of minutes: clients would take the rig for dead.
        if self._rig_free.acquire(blocking=False):
            try:
                self.description = self._rig.describe()
            finally:
                self._rig_free.release()
        return self.description

    def apply(self, gains: Gains, original: Gains | None = None) -> None:
        """Sets the live gains.

        Args:
            original: What a daemon would restore later, which the rig must accept, too.

        Raises:
            EstuneError: they are outside its bounds, the rig refuses them, or is occupied.
        """
        # Else gains that cannot be restored are noticed when nobody is there to choose others.
        for live in filter(None, (gains, original)):
            self.description.check_gains(live)
        with self._changing():
            self._rig.apply(gains)

    def switch_off(self, tables: Sequence[str]) -> None:
        """Switches compensations off."""
        if not isinstance(self._rig, CompensatedRig):
            raise RigError("this rig has no compensations of its own: none can be switched off")
        with self._changing():
            self._rig.switch_off(tables)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Block that changes the rig at rest; its description is then read anew."""
        if not self._rig_free.acquire(timeout=_RIG_WITHIN_S):
            raise RigError("the rig is occupied; try again")
        try:
            yield
            self.description = self._rig.describe()
        finally:
            self._rig_free.release()

    def limit_violation(self, request: TrialRequest) -> EstuneError | None:
        """Reason why the rig must not run a trial."""
        try:
            check_name("trial id", request.trial_id)
            self.description.limits.check(request.profile)
            self.description.check_gains(request.gains, trial=True)
            samples = request.profile.samples(self.description.controller.sampling_Hz)
        except InvalidInput as error:
            return error
        # With all columns of a compensation: it must not fail once the trial has been run.
        if record_frame.size(samples, optional=len(OPTIONAL_COLUMNS)) <= record_frame.MAX_BYTES:
            return None
        return InvalidInput(
            f"a trial of {samples} samples does not fit into a record of {record_frame.MAX_BYTES} "
            "bytes; request a shorter one"
        )

    def setpoint_violation(self, setpoint: Setpoint) -> EstuneError | None:
        """Reason why the rig must not follow a setpoint."""
        if not isinstance(self._rig, SetpointFollower):
            return RigError("this rig runs trials only: it follows no setpoints")
        try:
            self.description.limits.check_setpoint(setpoint.tension_N)
        except InvalidInput as error:
            return error
        return None

    def follow(self, setpoint: Setpoint) -> Feedback:
        """Has the reel follow a setpoint."""
        assert isinstance(self._rig, SetpointFollower)  # noqa: S101  else it was refused above
        return self._rig.follow(setpoint)

    def note(self, trial: ActiveTrial, *, begun: bool) -> EstuneError | TrialState:
        """Notes an accepted trial in the ledger; returns its state there, or the obstacle."""
        steps = (TrialEvent.SUBMIT, TrialEvent.START) if begun else (TrialEvent.SUBMIT,)
        try:
            return self._ledger.note(trial.request.trial_id, trial.digest, *steps)
        except ProtocolError:
            return TrialState.VOID  # it was voided while it was being accepted
        except EstuneError as error:
            return error

    def run(self, trial: ActiveTrial, *, begun: bool) -> bytes | EstuneError:
        """Runs a noted trial, notes its end, and returns its record's frame or its error."""
        result = self._run(trial, begun=begun)
        self._ledger.end(trial.request.trial_id, result)
        return result

    def _run(self, trial: ActiveTrial, *, begun: bool) -> bytes | EstuneError:
        request = trial.request
        try:
            with self._rig_free:
                if not begun:
                    begun = self._shared.may_begin()
                    if begun:
                        # On disk before anything moves: after a power cut it runs no second time.
                        self._ledger.note(request.trial_id, trial.digest, TrialEvent.START)
                record = self._rig.run(request) if begun else self._never_begun(request)
            if record.outcome is Outcome.CANCELLED:
                record = replace(record, reason=self._shared.stop_reason() or record.reason)
            return record_frame.encode(record)
        except RigError as error:
            reason = self._shared.stop_reason()
            if not reason:
                return error
            # It was stopped as it was about to start, so that the rig refused it.
            record = self._never_begun(request)
            return record_frame.encode(replace(record, reason=f"{reason} ({error})"))
        except BaseException as error:  # noqa: BLE001  even SystemExit: a client waits for it
            return to_estune_error(error, f"trial {request.trial_id}")

    def _never_begun(self, request: TrialRequest) -> TrialRecord:
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        reason = "stopped before it began"
        return empty_record(request, self.description, Outcome.CANCELLED, reason, at)


def to_estune_error(error: BaseException, activity: str) -> EstuneError:
    """Converts an exception to an `EstuneError`; logs the trace of an unexpected one."""
    if isinstance(error, EstuneError):
        return error
    _log.error("the rig failed in %s", activity, exc_info=error)
    return RigError(
        f"the rig's own program failed in {activity}: {type(error).__name__}: {error}; "
        "the trace is in its log"
    )


def reply_from_ledger(trial_id: str, entry: LedgerEntry) -> Answer | bytes:
    """State of a trial in the ledger; its record, if the ledger holds it."""
    match entry.state:
        case TrialState.ENDED if entry.frame is not None:
            return entry.frame
        case TrialState.ENDED:
            return refusal(
                RigError(
                    f"trial {trial_id} has run, but the rig no longer holds its record; "
                    "submit the trial again under another number or attempt"
                ),
                trial_id,
            )
        case TrialState.FAILED:
            return Answer(ReplyCode.REFUSED, trial_id, entry.error, entry.sentence)
        case state:
            return Answer(OF_TRIAL[state], trial_id)


def digest_conflict(trial_id: str, entry: LedgerEntry, digest: str) -> Answer | None:
    """Refusal of a request, if the ledger holds another request under its id."""
    # The old record would pass for that of the new gains.
    if entry.state is TrialState.UNKNOWN or entry.digest == digest:
        return None
    return refusal(
        RigError(
            f"the rig has run another trial under the id {trial_id}, with other gains or another "
            "profile; give the run a new name"
        ),
        trial_id,
    )
