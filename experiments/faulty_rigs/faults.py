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
_ACCEPTED = Answer(ReplyCode.ACCEPTED)


def _handler(**methods: Callable[..., Any]) -> type[RequestHandler]:
    """A handler with other methods."""
    return type("FaultyHandler", (RequestHandler,), methods)


def _accepting(verb: str, words: str, answer: Answer = _ACCEPTED) -> type[RequestHandler]:
    """A handler with another answer where the right one refuses a command with these words."""
    execute = getattr(_right, verb)

    def faulty(handler: RequestHandler, command: Any) -> Any:
        given = execute(handler, command)
        refusal = given.answer if isinstance(given, Handled) else given
        if not isinstance(refusal, Answer) or words not in refusal.sentence:
            return given
        return Handled(answer) if isinstance(given, Handled) else answer

    return _handler(**{verb: faulty})


class _RunsAgain(RequestHandler):
    _times = 0

    def submit(self, command: commands.Submit) -> Handled:
        self._times += 1
        again = replace(command.request, attempt=command.request.attempt + self._times - 1)
        return _right.submit(self, replace(command, request=again, digest=messages.digest(again)))


def _without_reason_refused(
    handler: RequestHandler, verb: str, payload: bytes, reply: Callable[[bytes], None]
) -> None:
    try:
        json.loads(payload)["reason"]
    except (ValueError, KeyError, TypeError):
        if verb == "estop":
            reply(b'{"verdict":"refused","error":"ProtocolError"}')
            return
    _right.command(handler, verb, payload, reply)


def _rewriting(find: bytes, put: bytes) -> type[RequestHandler]:
    """A handler that accepts payloads that must be refused, by making valid ones of them."""

    def command(
        handler: RequestHandler, verb: str, payload: bytes, reply: Callable[[bytes], None]
    ) -> None:
        made = re.sub(find, put, payload)
        if made != payload and verb == "submit":  # the digest is the client's, of its own request
            sent = messages.decode(commands.Submit, made)
            made = messages.encode(replace(sent, digest=messages.digest(sent.request)))
        _right.command(handler, verb, made, reply)

    return _handler(command=command)


def _late(handler: RequestHandler) -> Description:
    if handler.status().trial_id:
        time.sleep(0.4)
    return _right.describe(handler)


def _known(handler: RequestHandler, trial_id: str, inquiry: Inquire) -> Answer | bytes:
    found = _right.result(handler, trial_id, inquiry)
    unknown = isinstance(found, Answer) and found.verdict is ReplyCode.UNKNOWN
    return Answer(ReplyCode.VOID, trial_id) if unknown else found


COMMANDS: dict[str, type[RequestHandler]] = {
    "a submit repeated runs again": _RunsAgain,
    "another request has a used id": _accepting(
        "submit", "another trial", Answer(ReplyCode.ENDED)
    ),
    "an emergency stop needs its reason": _handler(command=_without_reason_refused),
    "clear does nothing": _handler(clear=lambda *_: _ACCEPTED),
    "clear is accepted within a trial": _accepting("clear", "busy with trial"),
    "gains are accepted within a trial": _accepting("gains", "busy with trial"),
    "a second trial is accepted": _accepting("submit", "busy with trial"),
    "cancel does nothing": _handler(cancel=lambda *_: _ACCEPTED),
    "cancel of another trial stops this": _handler(
        cancel=lambda handler, command: _right.cancel(handler, replace(command, trial_id=""))
    ),
    "void does nothing": _handler(
        void=lambda _, command: Answer(ReplyCode.VOID, command.trial_id)
    ),
    "an unknown field is accepted": _rewriting(rb',\s*"colour":\s*"red"', b""),
    "a gain of NaN is accepted": _rewriting(rb'"P":\s*NaN', b'"P":1.0'),
    "a negative gain is accepted": _rewriting(rb'"P":\s*-1.0', b'"P":1.0'),
    "P = 0 is accepted": _rewriting(rb'"P":\s*0.0', b'"P":1.0'),
    "a message of any size is accepted": _rewriting(rb"\s+$", b""),
    "describe is 400 ms late within a trial": _handler(describe=_late),
    "ended trials are not counted": _handler(
        status=lambda handler: replace(_right.status(handler), ended=0)
    ),
    "describe has another instance": _handler(
        describe=lambda handler: replace(_right.describe(handler), instance="00000000")
    ),
    "the ledger's identity changes": _handler(
        describe=lambda handler: replace(_right.describe(handler), ledger=secrets.token_hex(8))
    ),
    "all parts of a record are the first": _handler(
        result=lambda handler, name, part: _right.result(handler, name, replace(part, offset=0))
    ),
    "a trial never submitted is void": _handler(result=_known),
}


# --- the link --------------------------------------------------------------------------------

Serve = Callable[[str, str], bool]
"""Whether a query of a key is answered: the key asked for, and the key served."""


def _answering(is_answered: Serve) -> type[ListeningSession]:
    """A session that answers other queries than it must, those with wildcards."""

    def serve(
        session: ListeningSession, key: str, answer: Callable[[bytes, Reply], None], lane: Any
    ) -> None:
        def replies(asked: str, payload: bytes) -> Iterable[tuple[str, bytes]]:
            found: list[bytes] = []
            if is_answered(asked, key):
                answer(payload, found.append)
            return [(key, data) for data in found]

        session.serve_many(key, replies, lane)

    return type("FaultySession", (ListeningSession,), {"serve": serve})


LINK: dict[str, type[ListeningSession]] = {
    "a wildcard command is obeyed": _answering(lambda _asked, _key: True),
    "a wildcard query is not answered": _answering(lambda asked, key: asked == key),
    "the status is not published": type(
        "MuteSession", (ListeningSession,), {"publish": lambda *_: None}
    ),
}


# --- the motion ------------------------------------------------------------------------------

Run = Callable[[Rig, TrialRequest], TrialRecord]


def _running(
    other: Callable[[Rig, TrialRequest], TrialRequest],
) -> Run:
    """Runs another trial than the one requested, and says that it was this one."""
    return lambda rig, request: replace(rig.run(other(rig, request)), gains=request.gains)


def _reporting(other: Callable[[Rig, TrialRecord], TrialRecord]) -> Run:
    """Runs the trial, and reports another record."""
    return lambda rig, request: other(rig, rig.run(request))


def _unmeasured(_: Rig, record: TrialRecord) -> TrialRecord:
    tension = np.array(record.tension_N)
    tension[tension.size // 2 :] = math.nan
    return replace(record, tension_N=tension)


def _not_restored(rig: Rig, request: TrialRequest) -> TrialRecord:
    record = rig.run(request)
    rig.apply(request.gains)
    return record


def _moved_twice(rig: Rig, request: TrialRequest) -> TrialRecord:
    rig.run(replace(request, attempt=request.attempt + 90))
    return rig.run(request)


MOTION: dict[str, Run] = {
    "a record names another rig": _reporting(lambda _, record: replace(record, rig="another")),
    "a record has other gains": _reporting(
        lambda rig, record: replace(record, gains=rig.describe().gains)
    ),
    "a record has another setpoint": _reporting(
        lambda _, record: replace(record, setpoint_N=1.01 * record.setpoint_N)
    ),
    "a record has no tension": _reporting(_unmeasured),
    "the live gains are not restored": _not_restored,
    "a trial's gains are ignored": _running(
        lambda rig, request: replace(request, gains=rig.describe().gains)
    ),
    "the setpoint filter is ignored": _running(
        lambda _, request: replace(request, gains=replace(request.gains, setpoint_filter_s=0.0))
    ),
    "the current is in N": _reporting(
        lambda rig, record: replace(
            record, current_A=record.current_A * rig.describe().newtons_per_ampere
        )
    ),
    "a trial moves the rig twice": _moved_twice,
}


def _ignore(_: object) -> None:
    pass


class FaultyRig:
    """A rig with a fault; implements `estune.trial.Rig`."""

    def __init__(self, rig: Rig, fault: str) -> None:
        self._rig, self._run = rig, MOTION.get(fault)
        self.describe, self.abort = rig.describe, rig.abort
        self.clear, self.close = rig.clear, rig.close
        self.apply = _ignore if fault == DEAF_TO_GAINS else rig.apply
        self.estop = _ignore if fault == RUNS_ON else rig.estop

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial with the fault."""
        return self._rig.run(request) if self._run is None else self._run(self._rig, request)


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
