"""Stands between the link and a rig: carries out what the table of `estune.link.rig` orders.

The thread that brings a trial in runs it; for as long as it does, another must be there to bring
the next command. Every command is answered within milliseconds, with one exception that saves a
quick rig half of its overhead: if the last trial took less than `PROMPT_S`, as a simulated one
does, this one's record is awaited and is itself the answer to the submit. Should it take longer
after all, the client asks again, is told by another thread, and nothing is lost.

The state is guarded by a lock that is never held while anything is written or anything moves, so
that a slow disk or a slow rig keeps neither a renewal nor an emergency stop waiting.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from queue import SimpleQueue

from estune import frame, protocol
from estune.bus.answers import clash, clashes, known, named, never_begun
from estune.errors import EstuneError, InvalidInput, ProtocolError, RigError
from estune.ledger import Entry, Ledger
from estune.link import events
from estune.link import rig as machine
from estune.link.state import Move, Order, RigState
from estune.link.trials import TrialEvent, TrialState
from estune.link.verdicts import OF_TRIAL, Verdict
from estune.protocol import (
    HOLDER_MAX,
    Answer,
    Cancel,
    Estop,
    Inquire,
    Lease,
    SetGains,
    Status,
    Submit,
    Void,
    check_name,
    refusal,
)
from estune.trial import (
    Outcome,
    Rig,
    RigDescription,
    Telemetry,
    TrialRequest,
    Watched,
)

PROMPT_S = 0.01
CLOSE_WITHIN_S = 10.0
_ABORT_AGAIN_S = 0.05
_RIG_WITHIN_S = 0.2

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Trial:
    """The trial in hand."""

    request: TrialRequest
    digest: str
    told_to_stop: bool = False
    stop_failed: EstuneError | None = None


class Attendant:
    """Answers for one rig. Knows nothing of the transport; may be called from any thread."""

    def __init__(self, rig: Rig, ledger: Ledger, changed: Callable[[], None]) -> None:
        """Begins to attend.

        Args:
            rig: The rig. It is called by one thread at a time, not always the same; `abort`,
                `estop`, `clear` and `telemetry` by others.
            ledger: What it remembers of trials.
            changed: Called when the status has changed.
        """
        self._rig = rig
        self._ledger = ledger
        self._changed = changed
        self._lock = threading.Lock()  # guards the state and the three below
        self._state = RigState(latched=ledger.latched)
        self._trial: _Trial | None = None
        self._prompt = False
        self._ended = threading.Condition(self._lock)
        self._leased = threading.Condition(self._lock)
        self._description = rig.describe()
        self._rig_free = threading.Lock()
        self._stopping: SimpleQueue[_Trial | None] = SimpleQueue()
        if ledger.latched:  # a stop outlives the power supply
            rig.estop(ledger.latched)
        # Ready from the start: no thread can be made while the interpreter shuts down. Daemons: a
        # rig that will not stop must not keep the process from ending.
        for name, work in (("aborts", self._stop_trials), ("lease", self._watch_lease)):
            threading.Thread(target=work, name=name, daemon=True).start()

    # --- commands ---

    def lease(self, command: Lease) -> Answer:
        """Grants the right to command, keeps it alive, or takes it back."""
        now_s = time.monotonic()
        event: events.Event
        match command.action:
            case "acquire":
                event = events.Acquire(command.lease, command.holder[:HOLDER_MAX])
            case "renew":
                event = events.Renew(command.lease)
            case "release":
                event = events.Release(command.lease)
        with self._lock:
            move = self._step(event, now_s)
            if command.action == "acquire":
                self._leased.notify_all()
        return Answer(move.verdict, sentence=move.sentence)

    def submit(self, command: Submit, answer: Callable[[Answer | bytes], None]) -> None:
        """Takes a trial in, unless it has been before, and runs it.

        Args:
            command: The trial.
            answer: Called once, with the record in a frame if it is at hand, else with why there
                is none (yet). Must not raise.

        Raises:
            ProtocolError: the digest is not that of the request; nothing was answered.
        """
        now_s = time.monotonic()
        trial_id = command.request.trial_id
        if protocol.digest(command.request) != command.digest:
            raise ProtocolError(
                f"the digest of trial {trial_id} is not that of its request: something on the way "
                "has changed it; it was not taken in"
            )
        objection = self._objection(command.request)
        with self._lock:
            entry = self._find(trial_id)
            if clashes(entry, command.digest):
                said: Answer | bytes = clash(trial_id)
                trial = None
            else:
                event = events.Submit(
                    *(command.lease, trial_id, entry.state),
                    objection="" if objection is None else str(objection),
                )
                move = self._step(event, now_s)
                trial = None
                if Order.TAKE_IN in move.orders:
                    trial = self._trial = _Trial(command.request, command.digest)
                else:
                    said = self._say(move, trial_id, entry, objection)
            prompt = self._prompt
        if trial is None:
            answer(said)
        else:
            self._perform(trial, answer, prompt=prompt)

    def result(self, trial_id: str, inquiry: Inquire, part_bytes: int = 0) -> Answer | bytes:
        """The state of a trial: its record in a frame, or a part of it, once it has ended.

        Args:
            trial_id: The trial.
            inquiry: What is asked.
            part_bytes: The longest part to answer with; 0 for any length.

        Raises:
            ProtocolError: the part asked for is none.
        """
        with self._lock:
            entry = self._find(trial_id)
            trial = self._trial
        unknown = entry.state is TrialState.UNKNOWN
        if unknown and trial is not None and trial.request.trial_id == trial_id:
            return Answer(Verdict.BUSY, trial_id)  # it is being written down
        if clashes(entry, inquiry.digest):
            return clash(trial_id)
        found = known(trial_id, entry)
        most = min(inquiry.length or part_bytes, part_bytes or inquiry.length)
        if isinstance(found, Answer) or not (inquiry.offset or most):
            return found
        return protocol.encode_part(found, inquiry.offset, most or len(found))

    def cancel(self, command: Cancel) -> Answer:
        """Has the trial under way stopped. The answer names it until the live gains are back."""
        now_s = time.monotonic()
        with self._lock:
            move = self._step(events.Cancel(command.lease, command.trial_id), now_s)
            trial = self._trial
            if move.verdict is not Verdict.ACCEPTED:
                return Answer(move.verdict, sentence=move.sentence)
            if trial is None or command.trial_id not in ("", trial.request.trial_id):
                return Answer(Verdict.ACCEPTED)
            failed, trial.stop_failed = trial.stop_failed, None
            if failed is not None:
                return refusal(failed, trial.request.trial_id)
        return Answer(Verdict.ACCEPTED, trial.request.trial_id)

    def void(self, command: Void) -> Answer:
        """Sees to it that a trial never runs, unless it was taken in already."""
        now_s = time.monotonic()
        trial_id = check_name("trial id", command.trial_id)
        with self._lock:
            entry = self._ledger.find(trial_id)
            if clashes(entry, command.digest):
                return clash(trial_id)
            move = self._step(events.Void(command.lease, trial_id, entry.state), now_s)
        if Order.TOMBSTONE not in move.orders:
            return Answer(move.verdict, trial_id, sentence=move.sentence)
        # Its submit may have come in meanwhile: then the ledger says what it says of that trial.
        state = self._ledger.note(trial_id, command.digest, TrialEvent.VOID)
        return Answer(OF_TRIAL[state], trial_id)

    def set_gains(self, command: SetGains) -> Answer:
        """Makes gains the live ones, unless a trial is under way."""
        now_s = time.monotonic()
        with self._lock:
            move = self._step(events.SetGains(command.lease), now_s)
        if Order.APPLY not in move.orders:
            return Answer(move.verdict, self.status("").trial_id, sentence=move.sentence)
        if not self._rig_free.acquire(timeout=_RIG_WITHIN_S):
            return refusal(RigError("the rig is occupied; try again"))
        try:
            self._rig.apply(command.gains)
            self._description = self._rig.describe()
        except EstuneError as error:
            return refusal(error)
        finally:
            self._rig_free.release()
        return Answer(Verdict.ACCEPTED)

    def estop(self, command: Estop, answer: Callable[[Answer], None]) -> None:
        """Brings the rig to its safe state. The rig is told before anything else is done.

        Args:
            command: Why.
            answer: Called once the rig was told, before the stop is written down. Must not raise.
        """
        reason = command.reason[:HOLDER_MAX] or "no reason given"
        failed = None
        try:
            self._rig.estop(reason)
        except BaseException as error:  # noqa: BLE001  the stop must hold whatever the rig does
            failed = named(error, "the emergency stop")
        with self._lock:
            self._step(events.Estop(reason), time.monotonic())
        answer(Answer(Verdict.ACCEPTED) if failed is None else refusal(failed))
        _log.warning("emergency stop: %s", reason)
        self._ledger.latch(reason)

    def clear(self) -> Answer:
        """Ends an emergency stop."""
        with self._lock:
            move = self._step(events.Clear(), time.monotonic())
        if Order.CLEAR not in move.orders:
            return Answer(move.verdict, sentence=move.sentence)
        self._ledger.latch("")
        try:
            self._rig.clear()
        except EstuneError as error:
            return refusal(error)
        finally:
            with self._lock:
                latched = self._state.latched
            if latched:  # called again meanwhile: the later word is the stop's
                self._rig.estop(latched)
                self._ledger.latch(latched)
        return Answer(Verdict.ACCEPTED)

    # --- questions ---

    def status(self, instance: str) -> Status:
        """What the rig does now."""
        with self._lock:
            state = self._state
        return Status(
            instance=instance,
            mode=state.mode,
            trial_id="" if state.trial is None else state.trial.trial_id,
            ended=state.ended,
            holder="" if state.lease is None else state.lease.holder,
            latched=state.latched,
        )

    def describe(self) -> RigDescription:
        """What the rig is; while a trial is under way, as it was before."""
        if self._rig_free.acquire(blocking=False):
            try:
                self._description = self._rig.describe()
            finally:
                self._rig_free.release()
        return self._description

    def telemetry(self, after: int) -> Telemetry | None:
        """Samples of the trial under way from index `after` on, if the rig shows any."""
        if self._trial is None or not isinstance(self._rig, Watched):
            return None
        return self._rig.telemetry(after)

    def close(self) -> None:
        """Stops the trial under way, and returns once the live gains are back."""
        with self._lock:
            self._step(events.Close(), time.monotonic())
            self._leased.notify_all()
        self._stopping.put(None)
        with self._lock:
            ended = self._ended.wait_for(lambda: self._trial is None, CLOSE_WITHIN_S)
        if not ended:
            _log.error("the trial under way has not stopped within %g s", CLOSE_WITHIN_S)

    # --- within ---

    def _step(self, event: events.Event, now_s: float) -> Move:
        """Moves the state on, and has a trial stopped where that is ordered. The lock is held."""
        before = self._state
        move = machine.step(before, event, now_s)
        self._state = move.state
        trial = self._trial
        if Order.STOP in move.orders and trial is not None and not trial.told_to_stop:
            trial.told_to_stop = True
            self._stopping.put(trial)
        if move.state is not before and not isinstance(event, events.Renew):
            self._changed()
        return move

    def _find(self, trial_id: str) -> Entry:
        """What the ledger knows of a trial. The lock is held.

        One that is still in hand has not ended, even if the ledger says so already: its client
        would ask for the next, and be told that the rig is busy with this one.
        """
        entry, trial = self._ledger.find(trial_id), self._trial
        if trial is not None and trial.request.trial_id == trial_id and entry.state.is_final:
            return entry._replace(state=TrialState.RUNNING, frame=None)
        return entry

    def _say(
        self, move: Move, trial_id: str, entry: Entry, objection: EstuneError | None
    ) -> Answer | bytes:
        """The answer to a submit that was not taken in. The lock is held."""
        trial = self._trial
        if move.verdict is Verdict.BUSY and trial is not None:
            return Answer(Verdict.BUSY, trial.request.trial_id, sentence=move.sentence)
        if entry.state is not TrialState.UNKNOWN:
            return known(trial_id, entry)
        if move.verdict is Verdict.REFUSED:
            return refusal(objection or RigError(move.sentence), trial_id)
        return Answer(move.verdict, trial_id, sentence=move.sentence)

    def _objection(self, request: TrialRequest) -> EstuneError | None:
        """Why the rig must not run a trial."""
        try:
            check_name("trial id", request.trial_id)
            self._description.limits.check(request.profile)
            samples = request.profile.samples(self._description.controller.sampling_Hz)
        except InvalidInput as error:
            return error
        if frame.size(samples, reference=True) <= frame.MAX_BYTES:
            return None
        return InvalidInput(
            f"a trial of {samples} samples does not fit into a record of {frame.MAX_BYTES} bytes; "
            "ask for a shorter one"
        )

    def _perform(
        self, trial: _Trial, answer: Callable[[Answer | bytes], None], *, prompt: bool
    ) -> None:
        """Notes a trial that was taken in, runs it, and notes what came of it."""
        trial_id = trial.request.trial_id
        begun = prompt and self._may_begin()
        refused = self._note(trial, begun=begun)
        if refused is not None:
            self._let_go()
            answer(refused)
            return
        if not prompt:
            with self._lock:
                self._step(events.Noted(), time.monotonic())
            answer(Answer(Verdict.ACCEPTED, trial_id))
        began_s = time.monotonic()
        result = self._run(trial, begun=begun)
        quick = isinstance(result, bytes) and time.monotonic() - began_s < PROMPT_S
        self._ledger.end(trial_id, result)
        self._prompt = quick and not trial.told_to_stop
        self._let_go()
        if prompt:
            answer(result if isinstance(result, bytes) else refusal(result, trial_id))

    def _note(self, trial: _Trial, *, begun: bool) -> Answer | bytes | None:
        """Writes a trial into the ledger. The answer if it is not taken in after all."""
        trial_id = trial.request.trial_id
        events = (TrialEvent.SUBMIT, TrialEvent.START) if begun else (TrialEvent.SUBMIT,)
        try:
            state = self._ledger.note(trial_id, trial.digest, *events)
        except ProtocolError:
            state = TrialState.VOID
        except EstuneError as error:
            return refusal(error, trial_id)
        if state in (TrialState.ACCEPTED, TrialState.RUNNING):
            return None
        # It was voided while it was on its way into the ledger.
        return known(trial_id, self._ledger.find(trial_id))

    def _may_begin(self) -> bool:
        with self._lock:
            return self._step(events.Begin(), time.monotonic()).verdict is Verdict.ACCEPTED

    def _let_go(self) -> None:
        with self._lock:
            self._step(events.End(), time.monotonic())
            self._trial = None
            self._ended.notify_all()

    def _run(self, trial: _Trial, *, begun: bool) -> bytes | EstuneError:
        request = trial.request
        try:
            with self._rig_free:
                if not begun:
                    begun = self._may_begin()
                    if begun:
                        self._ledger.note(request.trial_id, trial.digest, TrialEvent.START)
                if begun:
                    record = self._rig.run(request)
                else:
                    record = never_begun(request, self._description)
            if record.outcome is Outcome.CANCELLED:
                record = replace(record, reason=self._why_stopped() or record.reason)
            return frame.encode(record)
        except RigError as error:
            why = self._why_stopped()
            if not why:
                return error
            # It was stopped as it was about to begin, so that the rig would not take it.
            record = never_begun(request, self._description)
            return frame.encode(replace(record, reason=f"{why} ({error})"))
        except BaseException as error:  # noqa: BLE001  even SystemExit: somebody waits for the trial
            return named(error, f"trial {request.trial_id}")

    def _why_stopped(self) -> str:
        with self._lock:
            return "" if self._state.trial is None else self._state.trial.stopping

    def _stop_trials(self) -> None:
        while (trial := self._stopping.get()) is not None:
            ended = False
            while not ended:  # again and again: the first call may come before the trial begins
                try:
                    self._rig.abort()
                except BaseException as error:  # noqa: BLE001  as above
                    if trial.stop_failed is None:
                        trial.stop_failed = named(error, "stopping the trial")
                with self._lock:
                    ended = self._ended.wait_for(partial(self._has_ended, trial), _ABORT_AGAIN_S)

    def _has_ended(self, trial: _Trial) -> bool:
        return self._trial is not trial

    def _watch_lease(self) -> None:
        """The dead-man's switch: ends a lease that is not renewed."""
        with self._lock:
            while not self._state.closed:
                lease, now_s = self._state.lease, time.monotonic()
                if lease is None:
                    self._leased.wait()
                elif now_s < lease.expires_at_s:
                    self._leased.wait(lease.expires_at_s - now_s)
                else:
                    _log.warning("the lease of %s ran out", lease.holder)
                    self._step(events.Expire(), now_s)
