"""The attendant: no trial runs twice, one at a time, by the lease, and every stop gets through."""

import logging
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from queue import SimpleQueue

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.errors import ProtocolError, RigError
from estune.remote.ledger import FileLedger, MemoryLedger
from estune.remote.messages import (
    Answer,
    Cancel,
    Estop,
    Inquire,
    Lease,
    SetGains,
    Status,
    Submit,
    Void,
    decode_part,
    digest,
)
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode
from estune.remote.state_machine.trials import TrialState
from estune.remote.zenoh.request_handler import RequestHandler
from estune.trial import Outcome, Telemetry, TrialRequest, record_frame
from tests.support_rigs import ScriptedRig, broken, description, response, same

GAINS = Gains(0.7, 12.0, 0.004, 0.01)
MINE, OTHERS = "mine", "others"


def trial(number: int = 0, **changes) -> TrialRequest:
    return TrialRequest("run", number, GAINS, replace(description().step, **changes))


class Attended(RequestHandler):
    """An attendant with the threads that bring it its questions."""

    def __init__(self, rig: ScriptedRig, ledger) -> None:
        self.announced = threading.Semaphore(0)
        super().__init__(rig, ledger, self.announced.release)
        self.acquire(MINE)

    def acquire(self, lease: str) -> Answer:
        return self.lease(Lease("acquire", lease, f"holder of {lease}"))

    def begin(self, request: TrialRequest, lease: str = MINE) -> Answer | bytes:
        """The answer to a submit, which need not wait for the trial."""
        answers = SimpleQueue()
        submit = Submit(lease, request, digest(request))
        threading.Thread(target=self.submit, args=(submit, answers.put)).start()
        return answers.get()

    def ask(self, request: TrialRequest, **inquiry) -> Answer | bytes:
        return self.result(request.trial_id, Inquire(digest(request), **inquiry))

    def stop(self, reason: str = "smoke") -> Answer:
        answers = SimpleQueue()
        self.estop(Estop(reason), answers.put)
        return answers.get()

    @property
    def now(self) -> Status:
        return self.status("0f")

    def wait(self) -> None:
        """Returns once no trial is under way; keeps the lease."""
        while self.now.trial_id:
            self.lease(Lease("renew", MINE))
            time.sleep(0.001)


@contextmanager
def attending(rig: ScriptedRig, ledger=None):
    attendant = Attended(rig, ledger or MemoryLedger())
    try:
        yield attendant
    finally:
        if isinstance(rig, HeldRig):
            rig.go.set()
        attendant.close()


class HeldRig(ScriptedRig):
    """Answers a trial only once it is let go."""

    def __init__(self) -> None:
        self.go = threading.Event()
        super().__init__(self._held)

    def _held(self, request):
        assert self.go.wait(60.0)
        return response(request)


# --- trials ---


def test_a_trial_submitted_again_before_and_after_its_end_runs_once():
    rig = HeldRig()
    with attending(rig) as attendant:
        assert attendant.begin(trial()).verdict is ReplyCode.ACCEPTED
        while not rig.asked:
            time.sleep(0.001)
        assert attendant.begin(trial()).verdict is ReplyCode.RUNNING
        assert attendant.ask(trial()).verdict is ReplyCode.RUNNING
        rig.go.set()
        attendant.wait()
        first = attendant.begin(trial())
        assert same(record_frame.decode(first), replace(response(trial()), rig="scripted"))
        assert attendant.ask(trial()) == first
    assert rig.asked == [trial()]


class LateLedger(MemoryLedger):
    """Returns from noting the end of a trial only once it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.noted, self.go = threading.Event(), threading.Event()

    def end(self, trial_id, outcome):
        super().end(trial_id, outcome)
        self.noted.set()
        assert self.go.wait(60.0)


def test_who_has_the_record_of_a_trial_can_have_the_next_one_begun():
    ledger = LateLedger()
    with attending(ScriptedRig(), ledger) as attendant:
        attendant.begin(trial())
        assert ledger.noted.wait(60.0)
        for answer in (attendant.ask(trial()), attendant.begin(trial())):
            assert answer.verdict is ReplyCode.RUNNING
        ledger.go.set()
        while isinstance(attendant.ask(trial()), Answer):
            time.sleep(0.001)
        following = attendant.begin(trial(1))
        assert isinstance(following, bytes) or following.verdict is ReplyCode.ACCEPTED


def test_a_record_is_handed_out_in_parts_to_who_asks_for_them():
    with attending(ScriptedRig()) as attendant:
        attendant.begin(trial())
        attendant.wait()
        whole, parts = attendant.ask(trial()), b""
        while len(parts) < len(whole):
            part = decode_part(attendant.ask(trial(), offset=len(parts), length=1000))
            assert (part.total, part.offset) == (len(whole), len(parts))
            parts += part.data
        assert parts == whole
        with pytest.raises(ProtocolError, match="none there"):
            attendant.ask(trial(), offset=len(whole), length=1)


def test_the_end_of_a_trial_is_announced():
    rig = HeldRig()
    with attending(rig) as attendant:
        attendant.begin(trial())
        while attendant.now.mode is not Mode.RUNNING:
            time.sleep(0.001)
        while attendant.announced.acquire(blocking=False):
            pass
        rig.go.set()
        assert attendant.announced.acquire(timeout=60.0)
        assert attendant.now.ended == 1


def test_a_rig_that_was_quick_is_awaited_and_its_record_is_the_answer():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        while not isinstance(state := attendant.begin(trial(len(rig.asked))), bytes):
            attendant.wait()  # the first is not awaited: nothing is known of the rig
        assert record_frame.decode(state).trial_id == rig.asked[-1].trial_id
    assert len(rig.asked) > 1


def test_a_rig_that_was_quick_and_is_not_any_more_is_told_of_by_the_other_thread():
    rig = HeldRig()
    with attending(rig) as attendant:
        attendant._prompt = True
        slow = threading.Thread(target=attendant.begin, args=(trial(),))
        slow.start()
        while not rig.asked:
            time.sleep(0.001)
        assert attendant.begin(trial()).verdict is ReplyCode.RUNNING
        rig.go.set()
        slow.join()
        assert isinstance(attendant.begin(trial()), bytes)
    assert rig.asked == [trial()]


def test_another_request_under_the_same_id_is_refused_and_not_run():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        attendant.begin(trial())
        attendant.wait()
        other = trial(step_N=6.0)
        for answer in (
            *(attendant.begin(other), attendant.ask(other)),
            attendant.void(Void(MINE, other.trial_id, digest(other))),
        ):
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
    assert rig.asked == [trial()]


def test_a_second_trial_and_new_gains_are_told_that_the_rig_is_busy_and_with_what():
    rig = HeldRig()
    with attending(rig) as attendant:
        attendant.begin(trial())
        for answer in (
            attendant.begin(trial(1)),
            attendant.set_gains(SetGains(MINE, replace(GAINS, P=2.0))),
        ):
            assert (answer.verdict, answer.trial_id) == (ReplyCode.BUSY, trial().trial_id)
            assert trial().trial_id in answer.sentence
        assert attendant.now.trial_id == trial().trial_id
        rig.go.set()
        attendant.wait()
        attendant.begin(trial(1))
        attendant.wait()
        assert attendant.now.ended == 2
    assert rig.asked == [trial(), trial(1)]


def test_while_a_trial_runs_the_description_is_that_of_the_rig_at_rest():
    rig = HeldRig()
    with attending(rig) as attendant:
        at_rest = attendant.describe()
        attendant.begin(trial())
        assert attendant.describe() == at_rest
        rig.go.set()


def test_what_the_rigs_program_raises_is_the_result_of_the_trial(caplog):
    with attending(ScriptedRig(broken)) as attendant:
        attendant.begin(trial())
        attendant.wait()
        answer = attendant.ask(trial())
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
        assert "ZeroDivisionError: no answer to 0" in answer.sentence
        assert attendant.now.mode is Mode.LEASED
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert "broken" in caplog.text


def test_a_trial_too_long_for_a_frame_is_refused_before_it_moves_anything():
    limits = replace(description().limits, duration_max_s=1e6)
    rig = ScriptedRig(limits=limits)
    with attending(rig) as attendant:
        answer = attendant.begin(trial(duration_s=1e4))
        assert answer.error == "InvalidInput"
        assert "shorter" in answer.sentence
    assert rig.asked == []


# --- the ledger ---


class Watched(MemoryLedger):
    """A ledger that notes what its rig had done at each note, and may be made to fail."""

    def __init__(self, rig: ScriptedRig) -> None:
        super().__init__()
        self.rig = rig
        self.notes: list[tuple[TrialState, int]] = []
        self.fails = False

    def note(self, *arguments):
        if self.fails:
            raise RigError("the disk is full")
        state = super().note(*arguments)
        self.notes.append((state, len(self.rig.asked)))
        return state

    def end(self, trial_id, outcome):
        super().end(trial_id, outcome)
        self.notes.append((TrialState.ENDED, len(self.rig.asked)))


@pytest.mark.parametrize("prompt", [False, True])
def test_a_trial_is_noted_before_it_moves_anything_and_when_it_has_ended(prompt):
    rig = ScriptedRig()
    ledger = Watched(rig)
    with attending(rig, ledger) as attendant:
        attendant._prompt = prompt
        attendant.begin(trial())
        attendant.wait()
    before = [] if prompt else [(TrialState.ACCEPTED, 0)]
    assert ledger.notes == [*before, (TrialState.RUNNING, 0), (TrialState.ENDED, 1)]


@pytest.mark.parametrize("prompt", [False, True])
def test_a_trial_that_cannot_be_noted_is_refused_and_not_run(prompt):
    rig = ScriptedRig()
    ledger = Watched(rig)
    with attending(rig, ledger) as attendant:
        ledger.fails, attendant._prompt = True, prompt
        answer = attendant.begin(trial())
        assert (answer.verdict, answer.sentence) == (ReplyCode.REFUSED, "the disk is full")
        assert attendant.ask(trial()).verdict is ReplyCode.UNKNOWN
        assert attendant.now.mode is Mode.LEASED
        ledger.fails = False
        attendant.begin(trial())
        attendant.wait()
    assert rig.asked == [trial()]


@pytest.mark.parametrize("prompt", [False, True])
def test_a_trial_voided_while_it_is_being_noted_does_not_run(prompt):
    rig, noting, go_on = ScriptedRig(), threading.Event(), threading.Event()

    class Slow(MemoryLedger):
        def note(self, trial_id, digest, *events):
            if len(events) == 1 + prompt and events[0] == "submit":
                noting.set()
                assert go_on.wait(60.0)
            return super().note(trial_id, digest, *events)

    ledger = Slow()
    with attending(rig, ledger) as attendant:
        attendant._prompt = prompt
        answers = []
        begun = threading.Thread(target=lambda: answers.append(attendant.begin(trial())))
        begun.start()
        assert noting.wait(60.0)
        assert attendant.ask(trial()).verdict is ReplyCode.BUSY
        if not prompt:
            voided = attendant.void(Void(MINE, trial().trial_id, digest(trial())))
            assert (voided.verdict, voided.trial_id) == (ReplyCode.BUSY, trial().trial_id)
        MemoryLedger.note(ledger, trial().trial_id, digest(trial()), "void")
        go_on.set()
        begun.join()
        assert answers[0].verdict is ReplyCode.VOID
        attendant.wait()
    assert rig.asked == []


def test_a_voided_trial_never_runs():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        void = Void(MINE, trial().trial_id, digest(trial()))
        assert attendant.void(void).verdict is ReplyCode.VOID
        assert attendant.begin(trial()).verdict is ReplyCode.VOID
        assert attendant.ask(trial()).verdict is ReplyCode.VOID
        attendant.begin(trial(1))
        attendant.wait()
        ended = Void(MINE, trial(1).trial_id, digest(trial(1)))
        assert attendant.void(ended).verdict is ReplyCode.ENDED
    assert rig.asked == [trial(1)]


# --- the lease ---


def test_only_the_holder_of_the_lease_commands_the_rig_and_the_others_are_told_who_it_is():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        void = Void(OTHERS, trial().trial_id, digest(trial()))
        for answer in (
            *(attendant.acquire(OTHERS), attendant.lease(Lease("renew", OTHERS))),
            *(attendant.begin(trial(), OTHERS), attendant.void(void)),
            attendant.set_gains(SetGains(OTHERS, GAINS)),
        ):
            assert answer.verdict is ReplyCode.HELD
            assert "holder of mine" in answer.sentence
        assert attendant.lease(Lease("release", MINE)).verdict is ReplyCode.ACCEPTED
        assert attendant.acquire(OTHERS).verdict is ReplyCode.ACCEPTED
        assert attendant.now.holder == "holder of others"
        assert attendant.begin(trial()).verdict is ReplyCode.HELD
        assert rig.asked == []


def test_a_lease_that_is_not_renewed_ends_its_trial_and_says_why():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        began_s = time.monotonic()
        attendant.begin(trial())
        while attendant.now.trial_id:
            time.sleep(0.001)
        assert time.monotonic() - began_s >= 0.9 * LEASE_S
        record = record_frame.decode(attendant.ask(trial()))
        assert record.outcome is Outcome.CANCELLED
        assert "holder of mine has not been heard of for 1 s" in record.reason
        assert attendant.now.mode is Mode.IDLE
        assert attendant.begin(trial(1)).verdict is ReplyCode.NO_LEASE
    assert rig.asked == [trial()]


def test_a_lease_that_is_renewed_lives_on():
    with attending(ScriptedRig(duration_s=1.6 * LEASE_S)) as attendant:
        attendant.begin(trial())
        attendant.wait()
        assert record_frame.decode(attendant.ask(trial())).outcome is Outcome.DONE


def test_a_client_that_lets_go_in_mid_trial_has_it_stopped():
    with attending(ScriptedRig(duration_s=60.0)) as attendant:
        attendant.begin(trial())
        attendant.lease(Lease("release", MINE))
        while attendant.now.trial_id:
            time.sleep(0.001)
        assert "let go" in record_frame.decode(attendant.ask(trial())).reason


# --- stopping ---


def test_a_trial_cancelled_before_it_began_is_not_run():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant._rig_free.acquire()  # keeps the trial from beginning
        attendant.begin(trial())
        assert attendant.cancel(Cancel(MINE)).trial_id == trial().trial_id
        attendant._rig_free.release()
        attendant.wait()
        record = record_frame.decode(attendant.ask(trial()))
        assert record.outcome is Outcome.CANCELLED
        assert record.gains == rig.describe().gains
        assert record.time_s.size == 0
    assert rig.asked == []


def test_cancel_names_the_trial_until_it_has_ended_and_spares_the_next():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant.begin(trial())
        while attendant.cancel(Cancel(MINE, trial().trial_id)).trial_id:
            time.sleep(0.001)
        attendant.begin(trial(1))
        assert attendant.cancel(Cancel(MINE, trial().trial_id)) == Answer(ReplyCode.ACCEPTED)
        assert attendant.now.trial_id == trial(1).trial_id


def test_closing_stops_the_trial_under_way_and_takes_in_no_more():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant.begin(trial())
        attendant.close()
        assert attendant.now.mode is Mode.CLOSED
        answer = attendant.begin(trial(1))
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")


def test_a_rig_that_cannot_be_stopped_says_so_each_time_it_is_asked_to():
    rig = HeldRig()
    rig.abort = lambda: broken(trial(7))
    with attending(rig) as attendant:
        attendant.begin(trial())
        while (answer := attendant.cancel(Cancel(MINE))).verdict is ReplyCode.ACCEPTED:
            time.sleep(0.001)
        assert "no answer to 7" in answer.sentence
        rig.go.set()
        attendant.wait()
        assert attendant.cancel(Cancel(MINE)) == Answer(ReplyCode.ACCEPTED)


def test_an_emergency_stop_ends_the_trial_and_holds_until_cleared():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant.begin(trial())
        while not rig.asked:
            time.sleep(0.001)
        assert attendant.stop("smoke").verdict is ReplyCode.ACCEPTED
        attendant.wait()
        record = record_frame.decode(attendant.ask(trial()))
        assert (record.outcome, record.reason) == (Outcome.CANCELLED, "emergency stop: smoke")
        assert (attendant.now.mode, attendant.now.latched) == (Mode.SAFE, "smoke")
        for answer in (attendant.begin(trial(1)), attendant.set_gains(SetGains(MINE, GAINS))):
            assert answer.verdict is ReplyCode.SAFE
            assert "smoke" in answer.sentence
        with pytest.raises(RigError, match="safe state"):
            rig.run(trial(2))
        assert attendant.clear().verdict is ReplyCode.ACCEPTED
        assert attendant.begin(trial(1)).verdict is ReplyCode.ACCEPTED


def test_an_emergency_stop_waits_for_no_trial_and_no_disk(tmp_path):
    rig, ledger = HeldRig(), FileLedger(tmp_path / "ledger", "scripted")
    with attending(rig, ledger) as attendant:
        attendant.begin(trial())
        while not rig.asked:
            time.sleep(0.001)
        answers = SimpleQueue()
        with ledger._writing:  # as while a commit takes its time
            stopping = threading.Thread(target=attendant.estop, args=(Estop("fire"), answers.put))
            stopping.start()
            assert answers.get(timeout=60.0).verdict is ReplyCode.ACCEPTED
            assert rig._latched == "fire"
        stopping.join()
        assert ledger.latched == "fire"
        rig.go.set()
    ledger.close()


def test_an_emergency_stop_that_fails_is_said_and_latches_all_the_same(caplog):
    rig = ScriptedRig()
    rig.estop = lambda reason: broken(trial(7))  # noqa: ARG005  called by position
    with attending(rig) as attendant:
        answer = attendant.stop()
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
        assert attendant.begin(trial()).verdict is ReplyCode.SAFE
    assert "emergency stop" in caplog.text
    assert rig.asked == []


def test_a_trial_stopped_in_the_moment_it_begins_is_cancelled_and_not_failed():
    rig = ScriptedRig()
    run = rig.run
    with attending(rig) as attendant:
        rig.run = lambda request: (attendant.stop("smoke"), run(request))[1]
        attendant.begin(trial())
        attendant.wait()
        record = record_frame.decode(attendant.ask(trial()))
    assert record.outcome is Outcome.CANCELLED
    assert record.reason.startswith("emergency stop: smoke (")
    assert rig.asked == []


def test_an_emergency_stop_outlives_the_rigs_program(tmp_path):
    for clear in (False, True):
        rig, ledger = ScriptedRig(), FileLedger(tmp_path / "ledger", "scripted")
        with attending(rig, ledger) as attendant:
            if not clear:
                attendant.stop("smoke")
            assert attendant.begin(trial()).verdict is ReplyCode.SAFE
            with pytest.raises(RigError):
                rig.apply(GAINS)
            if clear:
                attendant.clear()
                assert attendant.begin(trial()).verdict is ReplyCode.ACCEPTED
        ledger.close()
    assert rig.asked == [trial()]


def test_a_stop_that_comes_while_an_earlier_one_is_cleared_holds():
    rig = ScriptedRig()
    cleared = rig.clear
    with attending(rig) as attendant:
        attendant.stop("smoke")
        rig.clear = lambda: (attendant.stop("fire"), cleared())
        attendant.clear()
        assert attendant.now.latched == "fire"
        assert rig._latched == "fire"


# --- looking on ---


class ShowingRig(ScriptedRig):
    """Shows ten samples more at each look."""

    def telemetry(self, after):
        column = np.arange(after, after + 10.0)
        return Telemetry("run-00000", after, 200.0, column, column, column, column)


def test_samples_are_shown_only_while_a_trial_runs_and_by_a_rig_that_can():
    rig = ShowingRig(duration_s=60.0)
    with attending(rig) as attendant:
        assert attendant.telemetry(0) is None
        attendant.begin(trial())
        assert attendant.telemetry(20).first == 20
    with attending(ScriptedRig(duration_s=60.0)) as attendant:
        attendant.begin(trial())
        assert attendant.telemetry(0) is None
