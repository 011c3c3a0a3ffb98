"""Request handler: one trial at a time, none twice, lease holder only."""

import logging
import threading
import time
from contextlib import contextmanager
from dataclasses import fields, replace
from queue import SimpleQueue

import pytest

from estune.core.gains import Gains
from estune.errors import RigError
from estune.remote.ledger import MemoryLedger
from estune.remote.messages import VERBS, Answer, Inquire, Status, decode, digest
from estune.remote.messages.commands import Clear, Estop, Lease, Submit, Void
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode
from estune.remote.state_machine.trials import TrialState
from estune.remote.zenoh.request_handler import RequestHandler
from estune.trial import Outcome, TrialRequest, record_frame
from tests.support_rigs import ScriptedRig, broken, description, response, same

GAINS = Gains(0.7, 12.0, 0.004, 0.01)
MINE, OTHERS = "mine", "others"


def trial(number: int = 0, **changes) -> TrialRequest:
    return TrialRequest("run", number, GAINS, replace(description().step, **changes))


class ExercisedHandler(RequestHandler):
    """A request handler with the threads that bring it its queries."""

    def __init__(self, rig: ScriptedRig, ledger) -> None:
        self.announced = threading.Semaphore(0)
        super().__init__(rig, ledger, self.announced.release, instance="0f")
        self.acquire(MINE)

    def acquire(self, lease: str) -> Answer:
        return self.lease(Lease("acquire", lease, f"holder of {lease}"))

    def begin(self, request: TrialRequest, lease: str = MINE) -> Answer | bytes:
        """Reply to a submit; the trial may still be running."""
        answers = SimpleQueue()
        submit = Submit(lease, request, digest(request))
        threading.Thread(target=handle, args=(self.submit, submit, answers.put)).start()
        return answers.get()

    def ask(self, request: TrialRequest, **inquiry) -> Answer | bytes:
        return self.result(request.trial_id, Inquire(digest(request), **inquiry))

    def stop(self, reason: str = "smoke") -> Answer:
        answers = SimpleQueue()
        handle(self.estop, Estop(reason), answers.put)
        return answers.get()

    def reset(self) -> Answer:
        return self.clear(Clear())

    @property
    def now(self) -> Status:
        return self.status()

    def wait(self) -> None:
        """Returns once no trial is active; renews the lease."""
        while self.now.trial_id:
            self.lease(Lease("renew", MINE))
            time.sleep(0.001)


def handle(method, command, answer) -> None:
    """Serves a query like a server thread: first the reply, then the remaining work."""
    handled = method(command)
    answer(handled.answer)
    if handled.afterwards is not None:
        handled.afterwards()


@contextmanager
def handling(rig: ScriptedRig, ledger=None):
    handler = ExercisedHandler(rig, ledger or MemoryLedger())
    try:
        yield handler
    finally:
        if isinstance(rig, HeldRig):
            rig.go.set()
        handler.close()


class HeldRig(ScriptedRig):
    """Rig that completes a trial only after `go` is set."""

    def __init__(self) -> None:
        self.go = threading.Event()
        super().__init__(self._held)

    def _held(self, request):
        assert self.go.wait(60.0)
        return response(request)


def test_verbs_all_have_a_handler():
    assert all(callable(getattr(RequestHandler, name)) for name in VERBS)
    without = {n for n, v in VERBS.items() if "lease" not in {f.name for f in fields(v.message)}}
    assert without == {"estop", "clear"}


@pytest.mark.parametrize("text", ["\udcff", "x"], ids=["no text", "too long"])
def test_error_that_no_message_can_carry_is_answered_by_one_that_says_so(text):
    """Its thread would end, and leave every later command of its kind unanswered."""
    rig, replies, text = ScriptedRig(), [], 100_000 * text

    def fail():
        raise RigError(text)

    with handling(rig) as handler:
        rig.describe = fail
        handler.query(handler.describe, replies.append)
        handler.query(handler.status, replies.append)
    assert decode(Answer, replies[0]).error == "ProtocolError"
    assert decode(Status, replies[1]).mode is Mode.LEASED


# --- trials ---


def test_submit_repeated_runs_the_trial_once():
    rig = HeldRig()
    with handling(rig) as handler:
        assert handler.begin(trial()).verdict is ReplyCode.ACCEPTED
        while not rig.requests:
            time.sleep(0.001)
        assert handler.begin(trial()).verdict is ReplyCode.RUNNING
        assert handler.ask(trial()).verdict is ReplyCode.RUNNING
        rig.go.set()
        handler.wait()
        first = handler.begin(trial())
        assert same(record_frame.decode(first), replace(response(trial()), rig="scripted"))
        assert handler.ask(trial()) == first
    assert rig.requests == [trial()]


class LateLedger(MemoryLedger):
    """Ledger whose note of a trial's end returns only after `go` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.noted, self.go = threading.Event(), threading.Event()

    def end(self, trial_id, outcome):
        super().end(trial_id, outcome)
        self.noted.set()
        assert self.go.wait(60.0)


def test_result_is_withheld_until_the_next_trial_can_start():
    ledger = LateLedger()
    with handling(ScriptedRig(), ledger) as handler:
        handler.begin(trial())
        assert ledger.noted.wait(60.0)
        for answer in (handler.ask(trial()), handler.begin(trial())):
            assert answer.verdict is ReplyCode.RUNNING
        ledger.go.set()
        while isinstance(handler.ask(trial()), Answer):
            time.sleep(0.001)
        following = handler.begin(trial(1))
        assert isinstance(following, bytes) or following.verdict is ReplyCode.ACCEPTED


def test_end_of_a_trial_calls_changed():
    rig = HeldRig()
    with handling(rig) as handler:
        handler.begin(trial())
        while handler.now.mode is not Mode.RUNNING:
            time.sleep(0.001)
        while handler.announced.acquire(blocking=False):
            pass
        rig.go.set()
        assert handler.announced.acquire(timeout=60.0)
        assert handler.now.ended == 1


def test_submit_to_a_quick_rig_returns_the_record():
    rig = ScriptedRig()
    with handling(rig) as handler:
        while not isinstance(state := handler.begin(trial(len(rig.requests))), bytes):
            handler.wait()  # the first one does not wait: the rig's duration is unknown
        assert record_frame.decode(state).trial_id == rig.requests[-1].trial_id
    assert len(rig.requests) > 1


def test_submit_to_a_slow_rig_is_answered_by_another_thread():
    rig = HeldRig()
    with handling(rig) as handler:
        handler._prompt = True
        slow = threading.Thread(target=handler.begin, args=(trial(),))
        slow.start()
        while not rig.requests:
            time.sleep(0.001)
        assert handler.begin(trial()).verdict is ReplyCode.RUNNING
        rig.go.set()
        slow.join()
        assert isinstance(handler.begin(trial()), bytes)
    assert rig.requests == [trial()]


def test_request_under_a_used_id_is_refused_and_not_run():
    rig = ScriptedRig()
    with handling(rig) as handler:
        handler.begin(trial())
        handler.wait()
        other = trial(step_N=6.0)
        for answer in (
            *(handler.begin(other), handler.ask(other)),
            handler.void(Void(MINE, other.trial_id, digest(other))),
        ):
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
    assert rig.requests == [trial()]


def test_describe_during_a_trial_returns_the_rig_at_rest():
    rig = HeldRig()
    with handling(rig) as handler:
        at_rest = handler.describe().rig
        handler.begin(trial())
        assert handler.describe().rig == at_rest
        rig.go.set()


def test_exception_of_the_rig_is_the_result_of_the_trial(caplog):
    with handling(ScriptedRig(broken)) as handler:
        handler.begin(trial())
        handler.wait()
        answer = handler.ask(trial())
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
        assert "ZeroDivisionError: no answer to 0" in answer.sentence
        assert handler.now.mode is Mode.LEASED
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert "broken" in caplog.text


def test_submit_too_long_for_a_frame_is_refused():
    limits = replace(description().limits, duration_max_s=1e6)
    rig = ScriptedRig(limits=limits)
    with handling(rig) as handler:
        answer = handler.begin(trial(duration_s=1e4))
        assert answer.error == "InvalidInput"
        assert "shorter" in answer.sentence
    assert rig.requests == []


# --- the ledger ---


class CountingLedger(MemoryLedger):
    """Ledger that counts the rig's trials at each note, and may be made to fail."""

    def __init__(self, rig: ScriptedRig) -> None:
        super().__init__()
        self.rig = rig
        self.notes: list[tuple[TrialState, int]] = []
        self.fails = False

    def note(self, *arguments):
        if self.fails:
            raise RigError("the disk is full")
        state = super().note(*arguments)
        self.notes.append((state, len(self.rig.requests)))
        return state

    def end(self, trial_id, outcome):
        super().end(trial_id, outcome)
        self.notes.append((TrialState.ENDED, len(self.rig.requests)))


@pytest.mark.parametrize("prompt", [False, True])
def test_ledger_is_written_before_motion_and_after_the_end(prompt):
    rig = ScriptedRig()
    ledger = CountingLedger(rig)
    with handling(rig, ledger) as handler:
        handler._prompt = prompt
        handler.begin(trial())
        handler.wait()
    before = [] if prompt else [(TrialState.ACCEPTED, 0)]
    assert ledger.notes == [*before, (TrialState.RUNNING, 0), (TrialState.ENDED, 1)]


@pytest.mark.parametrize("prompt", [False, True])
def test_submit_without_a_writable_ledger_is_refused_and_not_run(prompt):
    rig = ScriptedRig()
    ledger = CountingLedger(rig)
    with handling(rig, ledger) as handler:
        ledger.fails, handler._prompt = True, prompt
        answer = handler.begin(trial())
        assert (answer.verdict, answer.sentence) == (ReplyCode.REFUSED, "the disk is full")
        assert handler.ask(trial()).verdict is ReplyCode.UNKNOWN
        assert handler.now.mode is Mode.LEASED
        ledger.fails = False
        handler.begin(trial())
        handler.wait()
    assert rig.requests == [trial()]


@pytest.mark.parametrize("prompt", [False, True])
def test_void_during_the_note_of_a_trial_prevents_it(prompt):
    rig, noting, go_on = ScriptedRig(), threading.Event(), threading.Event()

    class Slow(MemoryLedger):
        def note(self, trial_id, digest, *events):
            if len(events) == 1 + prompt and events[0] == "submit":
                noting.set()
                assert go_on.wait(60.0)
            return super().note(trial_id, digest, *events)

    ledger = Slow()
    with handling(rig, ledger) as handler:
        handler._prompt = prompt
        answers = []
        beginning = threading.Thread(target=lambda: answers.append(handler.begin(trial())))
        beginning.start()
        assert noting.wait(60.0)
        assert handler.ask(trial()).verdict is ReplyCode.BUSY
        if not prompt:
            voided = handler.void(Void(MINE, trial().trial_id, digest(trial())))
            assert (voided.verdict, voided.trial_id) == (ReplyCode.BUSY, trial().trial_id)
        MemoryLedger.note(ledger, trial().trial_id, digest(trial()), "void")
        go_on.set()
        beginning.join()
        assert answers[0].verdict is ReplyCode.VOID
        handler.wait()
    assert rig.requests == []


# --- the lease ---


def test_lease_renewed_stays_in_force():
    with handling(ScriptedRig(duration_s=1.6 * LEASE_S)) as handler:
        handler.begin(trial())
        handler.wait()
        assert record_frame.decode(handler.ask(trial())).outcome is Outcome.DONE


def test_lease_not_renewed_ends_though_nothing_else_happens():
    with handling(ScriptedRig()) as handler:
        for _ in ("acquired", "expired"):
            assert handler.announced.acquire(timeout=60.0)
        assert handler.now.holder == ""
