"""Stands between the link and a rig: carries out what the table of `estune.remote.state_machine.rig` orders.

The thread that brings a trial in runs it; for as long as it does, another must be there to bring
the next command. Every command is answered within milliseconds, with one exception that saves a
quick rig half of its overhead: if the last trial took less than `PROMPT_S`, as a simulated one
does, this one's record is awaited and is itself the answer to the submit. Should it take longer
after all, the client asks again, is told by another thread, and nothing is lost.

What is in hand is guarded by a lock (`estune.remote.zenoh.shared_rig_state`) that is never held while anything is
written or anything moves, so that a slow disk or a slow rig keeps neither a renewal nor an
emergency stop waiting.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from estune.errors import EstuneError, InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.ledger import Ledger, LedgerEntry
from estune.remote.messages import (
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
from estune.remote.state_machine import events
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import RigAction, Transition
from estune.remote.state_machine.trials import TrialEvent, TrialState
from estune.remote.zenoh.replies import (
    digest_conflict_reply,
    has_digest_conflict,
    never_begun,
    reply_from_ledger,
    to_estune_error,
)
from estune.remote.zenoh.shared_rig_state import ActiveTrial, SharedRigState
from estune.trial import (
    Outcome,
    Rig,
    RigDescription,
    Telemetry,
    TelemetrySource,
    TrialRequest,
    record_frame,
)

PROMPT_S = 0.01
CLOSE_WITHIN_S = 10.0
_ABORT_AGAIN_S = 0.05
_RIG_WITHIN_S = 0.2

_log = logging.getLogger(__name__)


class RequestHandler:
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
        self._prompt = False
        self._description = rig.describe()
        self._rig_free = threading.Lock()
        if ledger.latched:  # a stop outlives the power supply
            rig.estop(ledger.latched)
        self._duty = SharedRigState(rig, ledger.latched, changed)

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
        with self._duty.lock:
            move = self._duty.step(event, now_s)
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
        if messages.digest(command.request) != command.digest:
            raise ProtocolError(
                f"the digest of trial {trial_id} is not that of its request: something on the way "
                "has changed it; it was not taken in"
            )
        objection = self._limit_violation(command.request)
        with self._duty.lock:
            entry = self._find(trial_id)
            if has_digest_conflict(entry, command.digest):
                said: Answer | bytes = digest_conflict_reply(trial_id)
                trial = None
            else:
                event = events.SubmitEvent(
                    *(command.lease, trial_id, entry.state),
                    objection="" if objection is None else str(objection),
                )
                move = self._duty.step(event, now_s)
                trial = None
                if RigAction.TAKE_IN in move.orders:
                    trial = self._duty.trial = ActiveTrial(command.request, command.digest)
                else:
                    said = self._say(move, trial_id, entry, objection)
            prompt = self._prompt
        if trial is None:
            answer(said)
        else:
            self._run_accepted_trial(trial, answer, prompt=prompt)

    def result(self, trial_id: str, inquiry: Inquire, part_bytes: int = 0) -> Answer | bytes:
        """The state of a trial: its record in a frame, or a part of it, once it has ended.

        Args:
            trial_id: The trial.
            inquiry: What is asked.
            part_bytes: The longest part to answer with; 0 for any length.

        Raises:
            ProtocolError: the part asked for is none.
        """
        with self._duty.lock:
            entry = self._find(trial_id)
            trial = self._duty.trial
        unknown = entry.state is TrialState.UNKNOWN
        if unknown and trial is not None and trial.request.trial_id == trial_id:
            return Answer(ReplyCode.BUSY, trial_id)  # it is being written down
        if has_digest_conflict(entry, inquiry.digest):
            return digest_conflict_reply(trial_id)
        found = reply_from_ledger(trial_id, entry)
        most = min(inquiry.length or part_bytes, part_bytes or inquiry.length)
        if isinstance(found, Answer) or not (inquiry.offset or most):
            return found
        return messages.encode_part(found, inquiry.offset, most or len(found))

    def cancel(self, command: Cancel) -> Answer:
        """Has the trial under way stopped. The answer names it until the live gains are back."""
        now_s = time.monotonic()
        with self._duty.lock:
            move = self._duty.step(events.CancelEvent(command.lease, command.trial_id), now_s)
            trial = self._duty.trial
            if move.verdict is not ReplyCode.ACCEPTED:
                return Answer(move.verdict, sentence=move.sentence)
            if trial is None or command.trial_id not in ("", trial.request.trial_id):
                return Answer(ReplyCode.ACCEPTED)
            failed, trial.stop_failed = trial.stop_failed, None
            if failed is not None:
                return refusal(failed, trial.request.trial_id)
        return Answer(ReplyCode.ACCEPTED, trial.request.trial_id)

    def void(self, command: Void) -> Answer:
        """Sees to it that a trial never runs, unless it was taken in already."""
        now_s = time.monotonic()
        trial_id = check_name("trial id", command.trial_id)
        with self._duty.lock:
            entry = self._ledger.find(trial_id)
            if has_digest_conflict(entry, command.digest):
                return digest_conflict_reply(trial_id)
            move = self._duty.step(events.VoidEvent(command.lease, trial_id, entry.state), now_s)
        if RigAction.TOMBSTONE not in move.orders:
            return Answer(move.verdict, trial_id, sentence=move.sentence)
        # Its submit may have come in meanwhile: then the ledger says what it says of that trial.
        state = self._ledger.note(trial_id, command.digest, TrialEvent.VOID)
        return Answer(OF_TRIAL[state], trial_id)

    def set_gains(self, command: SetGains) -> Answer:
        """Makes gains the live ones, unless a trial is under way."""
        now_s = time.monotonic()
        with self._duty.lock:
            move = self._duty.step(events.SetGainsEvent(command.lease), now_s)
        if RigAction.APPLY not in move.orders:
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
        return Answer(ReplyCode.ACCEPTED)

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
            failed = to_estune_error(error, "the emergency stop")
        self._duty.apply_event(events.EstopEvent(reason))
        answer(Answer(ReplyCode.ACCEPTED) if failed is None else refusal(failed))
        _log.warning("emergency stop: %s", reason)
        self._ledger.latch(reason)

    def clear(self) -> Answer:
        """Ends an emergency stop."""
        move = self._duty.apply_event(events.ClearEvent())
        if RigAction.CLEAR not in move.orders:
            return Answer(move.verdict, sentence=move.sentence)
        self._ledger.latch("")
        try:
            self._rig.clear()
        except EstuneError as error:
            return refusal(error)
        finally:
            with self._duty.lock:
                latched = self._duty.state.latched
            if latched:  # called again meanwhile: the later word is the stop's
                self._rig.estop(latched)
                self._ledger.latch(latched)
        return Answer(ReplyCode.ACCEPTED)

    # --- questions ---

    def status(self, instance: str) -> Status:
        """What the rig does now."""
        with self._duty.lock:
            state = self._duty.state
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
        if self._duty.trial is None or not isinstance(self._rig, TelemetrySource):
            return None
        return self._rig.telemetry(after)

    def close(self) -> None:
        """Stops the trial under way, and returns once the live gains are back."""
        if not self._duty.close(CLOSE_WITHIN_S):
            _log.error("the trial under way has not stopped within %g s", CLOSE_WITHIN_S)

    # --- within ---

    def _find(self, trial_id: str) -> LedgerEntry:
        """What the ledger knows of a trial. The lock is held.

        One that is still in hand has not ended, even if the ledger says so already: its client
        would ask for the next, and be told that the rig is busy with this one.
        """
        entry, trial = self._ledger.find(trial_id), self._duty.trial
        if trial is not None and trial.request.trial_id == trial_id and entry.state.is_final:
            return entry._replace(state=TrialState.RUNNING, frame=None)
        return entry

    def _say(
        self, move: Transition, trial_id: str, entry: LedgerEntry, objection: EstuneError | None
    ) -> Answer | bytes:
        """The answer to a submit that was not taken in. The lock is held."""
        trial = self._duty.trial
        if move.verdict is ReplyCode.BUSY and trial is not None:
            return Answer(ReplyCode.BUSY, trial.request.trial_id, sentence=move.sentence)
        if entry.state is not TrialState.UNKNOWN:
            return reply_from_ledger(trial_id, entry)
        if move.verdict is ReplyCode.REFUSED:
            return refusal(objection or RigError(move.sentence), trial_id)
        return Answer(move.verdict, trial_id, sentence=move.sentence)

    def _limit_violation(self, request: TrialRequest) -> EstuneError | None:
        """Why the rig must not run a trial."""
        try:
            check_name("trial id", request.trial_id)
            self._description.limits.check(request.profile)
            samples = request.profile.samples(self._description.controller.sampling_Hz)
        except InvalidInput as error:
            return error
        if record_frame.size(samples, reference=True) <= record_frame.MAX_BYTES:
            return None
        return InvalidInput(
            f"a trial of {samples} samples does not fit into a record of {record_frame.MAX_BYTES} bytes; "
            "ask for a shorter one"
        )

    def _run_accepted_trial(
        self, trial: ActiveTrial, answer: Callable[[Answer | bytes], None], *, prompt: bool
    ) -> None:
        """Notes a trial that was taken in, runs it, and notes what came of it."""
        trial_id = trial.request.trial_id
        begun = prompt and self._duty.may_begin()
        refused = self._note(trial, begun=begun)
        if refused is not None:
            self._duty.finish_trial()
            answer(refused)
            return
        if not prompt:
            self._duty.apply_event(events.Noted())
            answer(Answer(ReplyCode.ACCEPTED, trial_id))
        began_s = time.monotonic()
        result = self._run(trial, begun=begun)
        quick = isinstance(result, bytes) and time.monotonic() - began_s < PROMPT_S
        self._ledger.end(trial_id, result)
        self._prompt = quick and not trial.told_to_stop
        self._duty.finish_trial()
        if prompt:
            answer(result if isinstance(result, bytes) else refusal(result, trial_id))

    def _note(self, trial: ActiveTrial, *, begun: bool) -> Answer | bytes | None:
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
        return reply_from_ledger(trial_id, self._ledger.find(trial_id))

    def _run(self, trial: ActiveTrial, *, begun: bool) -> bytes | EstuneError:
        request = trial.request
        try:
            with self._rig_free:
                if not begun:
                    begun = self._duty.may_begin()
                    if begun:
                        self._ledger.note(request.trial_id, trial.digest, TrialEvent.START)
                if begun:
                    record = self._rig.run(request)
                else:
                    record = never_begun(request, self._description)
            if record.outcome is Outcome.CANCELLED:
                record = replace(record, reason=self._duty.why_stopped() or record.reason)
            return record_frame.encode(record)
        except RigError as error:
            why = self._duty.why_stopped()
            if not why:
                return error
            # It was stopped as it was about to begin, so that the rig would not take it.
            record = never_begun(request, self._description)
            return record_frame.encode(replace(record, reason=f"{why} ({error})"))
        except BaseException as error:  # noqa: BLE001  even SystemExit: somebody waits for the trial
            return to_estune_error(error, f"trial {request.trial_id}")
