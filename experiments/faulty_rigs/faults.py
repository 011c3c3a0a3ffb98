"""Deliberate faults of a rig, by name: of its commands, its state, its link and its motion."""

import json
import math
import re
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.remote import messages
from estune.remote.messages import Answer, Description, Inquire, commands
from estune.remote.state_machine import events
from estune.remote.state_machine import rig as machine
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode, RigState, Transition
from estune.remote.zenoh.listening_session import ListeningSession, Reply
from estune.remote.zenoh.message_dispatcher import Handled
from estune.remote.zenoh.request_handler import RequestHandler
from estune.trial import Rig, TrialRecord, TrialRequest

Step = Callable[[RigState, Any, float], Transition]

step = machine.step
"""The transition function as it should be."""


# --- the state -------------------------------------------------------------------------------


def _with_any_lease(state: RigState, event: Any, now_s: float, *, kind: type[Any]) -> Transition:
    if isinstance(event, kind) and state.lease is not None:
        event = replace(event, token=state.lease.token)
    return step(state, event, now_s)


def _lease_for_all(state: RigState, event: Any, now_s: float) -> Transition:
    free = state._replace(lease=None) if isinstance(event, events.Acquire) else state
    return step(free, event, now_s)


def _lease_for_ever(state: RigState, event: Any, now_s: float) -> Transition:
    move = step(state, event, now_s)
    lease = move.state.lease
    kept = None if lease is None else lease._replace(expires_at_s=math.inf)
    return move._replace(state=move.state._replace(lease=kept))


def _runs_on(state: RigState, event: Any, now_s: float, *, kinds: tuple[Any, ...]) -> Transition:
    move = step(state, event, now_s)
    if not isinstance(event, kinds):
        return move
    return move._replace(orders=tuple(o for o in move.orders if o is not RigAction.STOP))


def _unlatched(state: RigState, event: Any, now_s: float) -> Transition:
    move = step(state, event, now_s)
    return move._replace(state=move.state._replace(latched=""))


def _runs_while_safe(state: RigState, event: Any, now_s: float) -> Transition:
    if isinstance(event, events.SubmitEvent) and state.mode is Mode.SAFE:
        state = state._replace(latched="")
    return step(state, event, now_s)


def _without_limit(state: RigState, event: Any, now_s: float, *, limit: str) -> Transition:
    if isinstance(event, events.SubmitEvent) and re.search(limit, event.objection):
        event = replace(event, objection="")
    return step(state, event, now_s)


STATE: dict[str, Step] = {
    "a submit needs no lease": partial(_with_any_lease, kind=events.SubmitEvent),
    "gains need no lease": partial(_with_any_lease, kind=events.SetGainsEvent),
    "a second client gets the lease": _lease_for_all,
    "the lease never expires": _lease_for_ever,
    "a trial runs on without its lease": partial(_runs_on, kinds=(events.Expire, events.Renew)),
    "a trial runs on after the release": partial(_runs_on, kinds=(events.Release,)),
    "the emergency stop does not last": _unlatched,
    "a trial runs in the safe state": _runs_while_safe,
    "a tension above the limit is accepted": partial(_without_limit, limit=r"setpoint [^-]\S* is"),
    "a tension below the limit is accepted": partial(_without_limit, limit=r"setpoint \S* is"),
    "a trial beyond the longest is accepted": partial(_without_limit, limit="longer than"),
}


# --- the commands ----------------------------------------------------------------------------

_right = RequestHandler


class _RunsAgain(RequestHandler):
    _times = 0

    def submit(self, command: commands.Submit) -> Handled:
        self._times += 1
        again = replace(command.request, attempt=command.request.attempt + self._times - 1)
        return _right.submit(self, replace(command, request=again, digest=messages.digest(again)))


class _OtherUnderUsedId(RequestHandler):
    def submit(self, command: commands.Submit) -> Handled:
        handled = _right.submit(self, command)
        answer = handled.answer
        refused = isinstance(answer, Answer) and "another trial" in answer.sentence
        return Handled(Answer(ReplyCode.ENDED)) if refused else handled


class _ReadsReasons(RequestHandler):
    def command(self, verb: str, payload: bytes, reply: Callable[[bytes], None]) -> None:
        try:
            json.loads(payload)["reason"]
        except (ValueError, KeyError, TypeError):
            if verb == "estop":
                reply(b'{"verdict":"refused","error":"ProtocolError"}')
                return
        _right.command(self, verb, payload, reply)


class _NeverClears(RequestHandler):
    def clear(self, _: commands.Clear) -> Answer:
        return Answer(ReplyCode.ACCEPTED)


class _ClearsInTrials(RequestHandler):
    def clear(self, command: commands.Clear) -> Answer:
        answer = _right.clear(self, command)
        return Answer(ReplyCode.ACCEPTED) if answer.verdict is ReplyCode.BUSY else answer


class _GainsInTrials(RequestHandler):
    def gains(self, command: commands.SetGains) -> Answer:
        answer = _right.gains(self, command)
        return Answer(ReplyCode.ACCEPTED) if answer.verdict is ReplyCode.BUSY else answer


class _TwoTrials(RequestHandler):
    def submit(self, command: commands.Submit) -> Handled:
        handled = _right.submit(self, command)
        answer = handled.answer
        busy = isinstance(answer, Answer) and answer.verdict is ReplyCode.BUSY
        return Handled(Answer(ReplyCode.ACCEPTED)) if busy else handled


class _DeafToCancel(RequestHandler):
    def cancel(self, _: commands.Cancel) -> Answer:
        return Answer(ReplyCode.ACCEPTED)


class _CancelsAny(RequestHandler):
    def cancel(self, command: commands.Cancel) -> Answer:
        return _right.cancel(self, replace(command, trial_id=""))


class _DeafToVoid(RequestHandler):
    def void(self, command: commands.Void) -> Answer:
        return Answer(ReplyCode.VOID, command.trial_id)


class _Rewrites(RequestHandler):
    """Accepts payloads that must be refused, by making valid ones of them."""

    find, put = b"", b""

    def command(self, verb: str, payload: bytes, reply: Callable[[bytes], None]) -> None:
        made = re.sub(self.find, self.put, payload)
        if made != payload and verb == "submit":  # the digest is the client's, of its own request
            sent = messages.decode(commands.Submit, made)
            made = messages.encode(replace(sent, digest=messages.digest(sent.request)))
        _right.command(self, verb, made, reply)


class _Late(RequestHandler):
    def describe(self) -> Description:
        if self.status().trial_id:
            time.sleep(0.4)
        return _right.describe(self)


class _CountsNothing(RequestHandler):
    def status(self) -> Any:
        return replace(_right.status(self), ended=0)


class _OtherInstance(RequestHandler):
    def describe(self) -> Description:
        return replace(_right.describe(self), instance="00000000")


class _NewLedger(RequestHandler):
    def describe(self) -> Description:
        return replace(_right.describe(self), ledger=secrets.token_hex(8))


class _FirstPartOnly(RequestHandler):
    def result(self, trial_id: str, inquiry: Inquire) -> Answer | bytes:
        return _right.result(self, trial_id, replace(inquiry, offset=min(inquiry.offset, 0)))


class _KnowsAllTrials(RequestHandler):
    def result(self, trial_id: str, inquiry: Inquire) -> Answer | bytes:
        found = _right.result(self, trial_id, inquiry)
        unknown = isinstance(found, Answer) and found.verdict is ReplyCode.UNKNOWN
        return Answer(ReplyCode.VOID, trial_id) if unknown else found


def _rewriting(find: bytes, put: bytes) -> type[RequestHandler]:
    return type("_Rewriting", (_Rewrites,), {"find": find, "put": put})


COMMANDS: dict[str, type[RequestHandler]] = {
    "a submit repeated runs again": _RunsAgain,
    "another request has a used id": _OtherUnderUsedId,
    "an emergency stop needs its reason": _ReadsReasons,
    "clear does nothing": _NeverClears,
    "clear is accepted within a trial": _ClearsInTrials,
    "gains are accepted within a trial": _GainsInTrials,
    "a second trial is accepted": _TwoTrials,
    "cancel does nothing": _DeafToCancel,
    "cancel of another trial stops this": _CancelsAny,
    "void does nothing": _DeafToVoid,
    "an unknown field is accepted": _rewriting(rb',\s*"colour":\s*"red"', b""),
    "a gain of NaN is accepted": _rewriting(rb'"P":\s*NaN', b'"P":1.0'),
    "a negative gain is accepted": _rewriting(rb'"P":\s*-1.0', b'"P":1.0'),
    "P = 0 is accepted": _rewriting(rb'"P":\s*0.0', b'"P":1.0'),
    "a message of any size is accepted": _rewriting(rb"\s+$", b""),
    "describe is 400 ms late within a trial": _Late,
    "ended trials are not counted": _CountsNothing,
    "describe has another instance": _OtherInstance,
    "the ledger's identity changes": _NewLedger,
    "all parts of a record are the first": _FirstPartOnly,
    "a trial never submitted is void": _KnowsAllTrials,
}


# --- the link --------------------------------------------------------------------------------


class _ObeysWildcards(ListeningSession):
    def serve(self, key: str, answer: Callable[[bytes, Reply], None], lane: Any) -> None:
        def replies(_asked: str, payload: bytes) -> Iterable[tuple[str, bytes]]:
            found: list[bytes] = []
            answer(payload, found.append)
            return [(key, data) for data in found]

        self.serve_many(key, replies, lane)


class _KnowsNoWildcards(ListeningSession):
    def serve(self, key: str, answer: Callable[[bytes, Reply], None], lane: Any) -> None:
        def replies(asked: str, payload: bytes) -> Iterable[tuple[str, bytes]]:
            found: list[bytes] = []
            if asked == key:
                answer(payload, found.append)
            return [(key, data) for data in found]

        self.serve_many(key, replies, lane)


class _Mute(ListeningSession):
    def publish(self, key: str, data: bytes) -> None:
        pass


LINK: dict[str, type[ListeningSession]] = {
    "a wildcard command is obeyed": _ObeysWildcards,
    "a wildcard query is not answered": _KnowsNoWildcards,
    "the status is not published": _Mute,
}


# --- the motion ------------------------------------------------------------------------------

Run = Callable[[Rig, TrialRequest], TrialRecord]


def _other_name(rig: Rig, request: TrialRequest) -> TrialRecord:
    return replace(rig.run(request), rig="another")


def _other_gains(rig: Rig, request: TrialRequest) -> TrialRecord:
    return replace(rig.run(request), gains=rig.describe().gains)


def _other_setpoint(rig: Rig, request: TrialRequest) -> TrialRecord:
    record = rig.run(request)
    return replace(record, setpoint_N=1.01 * record.setpoint_N)


def _unmeasured(rig: Rig, request: TrialRequest) -> TrialRecord:
    record = rig.run(request)
    tension = np.array(record.tension_N)
    tension[tension.size // 2 :] = math.nan
    return replace(record, tension_N=tension)


def _not_restored(rig: Rig, request: TrialRequest) -> TrialRecord:
    record = rig.run(request)
    rig.apply(request.gains)
    return record


def _gains_ignored(rig: Rig, request: TrialRequest) -> TrialRecord:
    ran = replace(request, gains=rig.describe().gains)
    return replace(rig.run(ran), gains=request.gains)


def _filter_ignored(rig: Rig, request: TrialRequest) -> TrialRecord:
    ran = replace(request, gains=replace(request.gains, setpoint_filter_s=0.0))
    return replace(rig.run(ran), gains=request.gains)


def _current_in_newtons(rig: Rig, request: TrialRequest) -> TrialRecord:
    record = rig.run(request)
    return replace(record, current_A=record.current_A * rig.describe().newtons_per_ampere)


def _moved_twice(rig: Rig, request: TrialRequest) -> TrialRecord:
    rig.run(replace(request, attempt=request.attempt + 90))
    return rig.run(request)


MOTION: dict[str, Run] = {
    "a record names another rig": _other_name,
    "a record has other gains": _other_gains,
    "a record has another setpoint": _other_setpoint,
    "a record has no tension": _unmeasured,
    "the live gains are not restored": _not_restored,
    "a trial's gains are ignored": _gains_ignored,
    "the setpoint filter is ignored": _filter_ignored,
    "the current is in N": _current_in_newtons,
    "a trial moves the rig twice": _moved_twice,
}


class FaultyRig:
    """A rig whose trials have a fault; implements `estune.trial.Rig`."""

    def __init__(self, rig: Rig, run: Run | None = None, *, stops: bool = True) -> None:
        self._rig, self._run = rig, run
        self.describe, self.abort, self.apply = rig.describe, rig.abort, rig.apply
        self.clear, self.close, self.stops = rig.clear, rig.close, stops

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial with the fault."""
        return self._rig.run(request) if self._run is None else self._run(self._rig, request)

    def estop(self, reason: str) -> None:
        """Stops the rig, unless that is its fault."""
        if self.stops:
            self._rig.estop(reason)


class _DeafToGains(FaultyRig):
    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self.apply = self._ignore

    def _ignore(self, gains: Gains) -> None:
        pass


DEAF_TO_GAINS, RUNS_ON = "gains set have no effect", "a trial runs on after an emergency stop"
FAULTS = (*STATE, *COMMANDS, *LINK, *MOTION, DEAF_TO_GAINS, RUNS_ON)
"""All faults."""

MISSED_ONCE = (
    "a trial's gains are ignored",
    "the setpoint filter is ignored",
    "the current is in N",
    "a tension below the limit is accepted",
    "P = 0 is accepted",
    "clear is accepted within a trial",
    "describe is 400 ms late within a trial",
    "a trial moves the rig twice",
)
"""Faults of which an earlier suite found none."""


def with_fault(rig: Rig, fault: str) -> Any:
    """A rig with a fault of its motion; the same rig for another fault."""
    if fault == DEAF_TO_GAINS:
        return _DeafToGains(rig)
    return FaultyRig(rig, MOTION.get(fault), stops=fault != RUNS_ON)
