"""Server side of one rig: executes the commands to it, and answers what is asked of it.

The thread that brings a submit runs the trial; another thread must then be free for the next
command. Every command is answered within milliseconds, with one exception that saves a quick rig
half of its overhead: if the last trial took less than `PROMPT_S`, as a simulated one does, the
submit is answered with the record itself. Should this trial take longer, the client asks again,
another thread answers, and nothing is lost.
"""

import logging
import time
from collections.abc import Callable
from functools import partial

from estune.errors import EstuneError, ProtocolError, RigError, StaleSetpoint
from estune.remote import messages
from estune.remote.ledger import Ledger, LedgerEntry
from estune.remote.messages import (
    HOLDER_MAX,
    Answer,
    Description,
    Following,
    Inquire,
    Status,
    check_name,
    commands,
    refusal,
)
from estune.remote.state_machine import events
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.setpoint_age import SetpointAge
from estune.remote.state_machine.state import Transition
from estune.remote.state_machine.trials import TrialEvent, TrialState
from estune.remote.zenoh.message_dispatcher import CommandListener, Handled, MessageDispatcher
from estune.remote.zenoh.trial_execution import (
    ActiveTrial,
    SharedRigState,
    TrialExecutor,
    digest_conflict,
    reply_from_ledger,
    to_estune_error,
)
from estune.trial import SETPOINT_S, Rig, Telemetry, TelemetrySource

PROMPT_S = 0.01  # a reply that takes longer would delay those behind it
CLOSE_WITHIN_S = 10.0

_log = logging.getLogger(__name__)


class RequestHandler(MessageDispatcher):
    """Executes the commands to one rig. Independent of the transport; any thread may call.

    Each verb of the protocol is executed by the method of the same name.
    """

    def __init__(
        self,
        rig: Rig,
        ledger: Ledger,
        changed: Callable[[], None],
        *,
        instance: str,
        part_bytes: int = 0,
        heard: CommandListener = lambda *_: None,
    ) -> None:
        """Takes charge of a rig.

        Args:
            rig: The rig. It is called by one thread at a time, not always the same; `abort`,
                `estop`, `clear`, `follow` and `telemetry` by others.
            changed: Called when the status has changed.
            instance: Identity of this start of the rig.
            part_bytes: Size of the parts of records; 0 sends them whole.
            heard: Called after the reply to each command.
        """
        super().__init__(heard)
        self._rig = rig
        self._ledger = ledger
        self._instance = instance
        self._part_bytes = part_bytes
        self._prompt = False
        self._setpoint_age = SetpointAge()
        description = rig.describe()
        if ledger.latched:  # a stop outlives the power supply
            rig.estop(ledger.latched)
        self._shared = SharedRigState(rig, ledger.latched, changed)
        self._executor = TrialExecutor(rig, ledger, self._shared, description)

    # --- commands ---

    def lease(self, command: commands.Lease) -> Answer:
        """Grants, renews or ends the lease."""
        event: events.Event
        match command.action:
            case "acquire":
                holder = command.holder[:HOLDER_MAX].strip() or "a client without a name"
                event = events.Acquire(command.lease, holder)
            case "renew":
                event = events.Renew(command.lease)
            case "release":
                event = events.Release(command.lease)
        return _answer(self._shared.apply_event(event))

    def submit(self, command: commands.Submit) -> Handled:
        """Accepts a trial, unless the ledger has an entry of it, and runs it."""
        now_s = time.monotonic()
        request, trial_id = command.request, command.request.trial_id
        if messages.digest(request) != command.digest:
            raise ProtocolError(
                f"the digest of trial {trial_id} is not that of its request, which was changed in "
                "transit; it was not accepted; submit it again"
            )
        violation = self._executor.limit_violation(request)
        with self._shared.lock:
            entry = self._find(trial_id)
            if conflict := digest_conflict(trial_id, entry, command.digest):
                return Handled(conflict)
            objection = "" if violation is None else str(violation)
            event = events.SubmitEvent(command.lease, trial_id, entry.state, objection)
            move = self._shared.step(event, now_s)
            if RigAction.TAKE_IN not in move.orders:
                refused = self._not_accepted(move, trial_id, entry, violation)
                return Handled(self._in_parts(refused))
            trial = self._shared.trial = ActiveTrial(request, command.digest)
            prompt = self._prompt
        return self._start(trial, prompt=prompt)

    def cancel(self, command: commands.Cancel) -> Answer:
        """Stops the active trial. The reply names it until the live gains are restored."""
        now_s = time.monotonic()
        with self._shared.lock:
            event = events.CancelEvent(command.lease, command.trial_id)
            move = self._shared.step(event, now_s)
            trial = self._shared.trial
            if move.reply_code is not ReplyCode.ACCEPTED:
                return _answer(move)
            if trial is None or command.trial_id not in ("", trial.request.trial_id):
                return Answer(ReplyCode.ACCEPTED)
            error, trial.stop_error = trial.stop_error, None
        trial_id = trial.request.trial_id
        return Answer(ReplyCode.ACCEPTED, trial_id) if error is None else refusal(error, trial_id)

    def void(self, command: commands.Void) -> Answer:
        """Notes that a trial must never run, unless it was accepted already."""
        now_s = time.monotonic()
        trial_id = check_name("trial id", command.trial_id)
        with self._shared.lock:
            entry = self._ledger.find(trial_id)
            if conflict := digest_conflict(trial_id, entry, command.digest):
                return conflict
            event = events.VoidEvent(command.lease, trial_id, entry.state)
            move = self._shared.step(event, now_s)
        if RigAction.TOMBSTONE not in move.orders:
            return _answer(move, trial_id)
        # If its submit has arrived meanwhile, the ledger returns the state of that trial.
        state = self._ledger.note(trial_id, command.digest, TrialEvent.VOID)
        return Answer(OF_TRIAL[state], trial_id)

    def gains(self, command: commands.SetGains) -> Answer:
        """Sets the live gains, unless a trial is active."""
        apply = partial(self._executor.apply, command.gains, command.original)
        answer = self._change(events.SetGainsEvent(command.lease), RigAction.APPLY, apply)
        if answer.verdict is ReplyCode.ACCEPTED:
            self._ledger.keep_original(command.gains, command.original)
        return answer

    def switch_off(self, command: commands.SwitchOff) -> Answer:
        """Switches compensations off, unless a trial is active."""
        apply = partial(self._executor.switch_off, command.tables)
        return self._change(events.SwitchOffEvent(command.lease), RigAction.SWITCH_OFF, apply)

    def _change(self, event: events.Event, action: RigAction, apply: Callable[[], None]) -> Answer:
        """Changes the rig at rest, if the transition orders it."""
        move = self._shared.apply_event(event)
        if action not in move.orders:
            return _answer(move, self.status().trial_id)
        try:
            apply()
        except EstuneError as error:
            return refusal(error)
        return Answer(ReplyCode.ACCEPTED)

    def follow(self, command: commands.Follow) -> Answer | Following:
        """Passes a setpoint to the rig, unless a trial is active or the setpoint is an old one."""
        now_s = time.monotonic()
        violation = self._executor.setpoint_violation(command.setpoint)
        with self._shared.lock:
            age = self._setpoint_age.next(command.lease, command.sent_s, now_s)
            if age is None:
                violation = StaleSetpoint(
                    "the setpoint was dropped: a newer one arrived before, or it was under way "
                    f"for more than {SETPOINT_S:g} s; check the network and the machine's load"
                )
            event = events.FollowEvent(command.lease, str(violation or ""))
            move = self._shared.step(event, now_s)
            follows = RigAction.FOLLOW in move.orders
            if follows and age is not None:
                self._setpoint_age = age
        if follows:
            return Following(command.sent_s, self._executor.follow(command.setpoint))
        if move.reply_code is ReplyCode.REFUSED:
            return refusal(violation or RigError(move.sentence))
        return _answer(move, self.status().trial_id)

    def estop(self, command: commands.Estop) -> Handled:
        """Brings the rig to its safe state, before anything else is done."""
        reason = command.reason[:HOLDER_MAX] or "no reason given"
        answer = Answer(ReplyCode.ACCEPTED)
        self._shared.estop_under_way = f"emergency stop: {reason}"
        try:
            self._rig.estop(reason)
        except BaseException as error:  # noqa: BLE001  the stop must hold whatever the rig does
            answer = refusal(to_estune_error(error, "the emergency stop"))
        self._shared.apply_event(events.EstopEvent(reason))
        self._shared.estop_under_way = ""
        return Handled(answer, partial(self._latch, reason))

    def clear(self, _: commands.Clear) -> Answer:
        """Resets the emergency stop."""
        move = self._shared.apply_event(events.ClearEvent())
        if RigAction.CLEAR not in move.orders:
            return _answer(move)
        self._ledger.latch("")
        try:
            self._rig.clear()
        except EstuneError as error:
            return refusal(error)
        finally:
            with self._shared.lock:
                latched = self._shared.state.latched
            if latched:  # stopped again meanwhile: the later command is the stop
                self._rig.estop(latched)
                self._ledger.latch(latched)
        return Answer(ReplyCode.ACCEPTED)

    # --- queries ---

    def result(self, trial_id: str, inquiry: Inquire) -> Answer | bytes:
        """State of a trial; once it has ended, its record in a frame, or a part of the frame."""
        with self._shared.lock:
            entry = self._find(trial_id)
            trial = self._shared.trial
        unknown = entry.state is TrialState.UNKNOWN
        if unknown and trial is not None and trial.request.trial_id == trial_id:
            return Answer(ReplyCode.BUSY, trial_id)  # it is being written to the ledger
        if conflict := digest_conflict(trial_id, entry, inquiry.digest):
            return conflict
        found = reply_from_ledger(trial_id, entry)
        most = min(inquiry.length or self._part_bytes, self._part_bytes or inquiry.length)
        if isinstance(found, Answer) or not (inquiry.offset or most):
            return found
        return messages.encode_part(found, inquiry.offset, most or len(found))

    def status(self, asked: bytes = b"") -> Status:
        """Current state of the rig; with its youngest trial, if that is asked for."""
        with self._shared.lock:
            state = self._shared.state
        return Status(
            instance=self._instance,
            mode=state.mode,
            trial_id=state.trial_id,
            ended=state.ended,
            holder="" if state.lease is None else state.lease.holder,
            latched=state.latched,
            last=self._ledger.last if asked == messages.LAST else "",
        )

    def describe(self) -> Description:
        """Properties of the rig; during a trial those before it."""
        rig = self._executor.describe()
        original = self._ledger.original_of(rig.gains)
        return Description(rig, self._instance, self._ledger.identity, original=original)

    @property
    def is_showing(self) -> bool:
        """Whether a trial is active whose samples the rig provides."""
        return self._shared.trial is not None and isinstance(self._rig, TelemetrySource)

    def telemetry(self, after: int) -> Telemetry | None:
        """Samples of the active trial from index `after` on, if the rig provides them."""
        if self._shared.trial is None or not isinstance(self._rig, TelemetrySource):
            return None
        return self._rig.telemetry(after)

    def close(self) -> None:
        """Stops the active trial, and returns once the live gains are restored."""
        if not self._shared.close(CLOSE_WITHIN_S):
            _log.error("the active trial has not stopped within %g s", CLOSE_WITHIN_S)

    # --- trials ---

    def _find(self, trial_id: str) -> LedgerEntry:
        # The active trial has not ended, even if the ledger already says so: its client would
        # submit the next trial, and find the rig busy with this one.
        entry, trial = self._ledger.find(trial_id), self._shared.trial
        if trial is not None and trial.request.trial_id == trial_id and entry.state.is_final:
            return entry._replace(state=TrialState.RUNNING, frame=None)
        return entry

    def _not_accepted(
        self, move: Transition, trial_id: str, entry: LedgerEntry, violation: EstuneError | None
    ) -> Answer | bytes:
        """Reply to a submit that was not accepted. The lock is held."""
        trial = self._shared.trial
        if move.reply_code is ReplyCode.BUSY and trial is not None:
            return _answer(move, trial.request.trial_id)
        if entry.state is not TrialState.UNKNOWN:
            return reply_from_ledger(trial_id, entry)
        if move.reply_code is ReplyCode.REFUSED:
            return refusal(violation or RigError(move.sentence), trial_id)
        return _answer(move, trial_id)

    def _start(self, trial: ActiveTrial, *, prompt: bool) -> Handled:
        """Notes an accepted trial and runs it: before the reply if prompt, else after it."""
        trial_id = trial.request.trial_id
        begun = prompt and self._shared.may_begin()
        noted = self._executor.note(trial, begun=begun)
        if noted not in (TrialState.ACCEPTED, TrialState.RUNNING):
            self._shared.finish_trial()
            if isinstance(noted, EstuneError):
                return Handled(refusal(noted, trial_id))
            return Handled(
                self._in_parts(reply_from_ledger(trial_id, self._ledger.find(trial_id)))
            )
        if prompt:
            result = self._run(trial, begun=begun)
            answer = result if isinstance(result, bytes) else refusal(result, trial_id)
            return Handled(self._in_parts(answer))
        self._shared.apply_event(events.Noted())
        return Handled(Answer(ReplyCode.ACCEPTED, trial_id), partial(self._run, trial))

    def _run(self, trial: ActiveTrial, *, begun: bool = False) -> bytes | EstuneError:
        began_s = time.monotonic()
        result = self._executor.run(trial, begun=begun)
        quick = isinstance(result, bytes) and time.monotonic() - began_s < PROMPT_S
        self._prompt = quick and not trial.is_stopping
        self._shared.finish_trial()
        return result

    def _in_parts(self, answer: Answer | bytes) -> Answer | bytes:
        whole = self._part_bytes and isinstance(answer, bytes)
        return Answer(ReplyCode.ENDED) if whole else answer

    def _latch(self, reason: str) -> None:
        _log.warning("emergency stop: %s", reason)
        with self._shared.lock:
            latched = self._shared.state.latched  # the first reason; empty if cleared meanwhile
        self._ledger.latch(latched)


def _answer(move: Transition, trial_id: str = "") -> Answer:
    return Answer(move.reply_code, trial_id, sentence=move.sentence)
