"""The attendant and its ledger: no trial runs twice, one at a time, nothing is left unsaid."""

import logging
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from queue import SimpleQueue

from estune import frame
from estune.bus.attendant import Attendant
from estune.bus.ledger import Ledger
from estune.core.gains import Gains
from estune.protocol import Answer, Cancel, SetGains, Submit, digest
from estune.trial import Outcome, TrialRequest
from tests.support_rigs import ScriptedRig, broken, description, response, same

GAINS = Gains(0.7, 12.0, 0.004, 0.01)


def trial(number: int = 0, **changes) -> TrialRequest:
    return TrialRequest("run", number, GAINS, replace(description().step, **changes))


class Attended(Attendant):
    """An attendant with the threads that bring it its questions."""

    def __init__(self, rig: ScriptedRig) -> None:
        self.announced = threading.Semaphore(0)
        super().__init__(rig, self.announced.release)

    def begin(self, request: TrialRequest) -> Answer | bytes:
        """The answer to a submit, which need not wait for the trial."""
        answers = SimpleQueue()
        submit = Submit(request, digest(request))
        threading.Thread(target=self.submit, args=(submit, answers.put)).start()
        return answers.get()

    def wait(self) -> None:
        """Returns once no trial is under way."""
        while self.status().trial_id:
            time.sleep(0.001)


@contextmanager
def attending(rig: ScriptedRig):
    attendant = Attended(rig)
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


def test_a_trial_submitted_again_before_and_after_its_end_runs_once():
    rig = HeldRig()
    with attending(rig) as attendant:
        assert attendant.begin(trial()).verdict == "accepted"
        assert attendant.begin(trial()).verdict == "known"
        assert attendant.result(trial().trial_id, digest(trial())).verdict == "known"
        rig.go.set()
        attendant.wait()
        first = attendant.begin(trial())
        assert same(frame.decode(first), replace(response(trial()), rig="scripted"))
        assert attendant.result(trial().trial_id, digest(trial())) == first
    assert rig.asked == [trial()]


def test_the_end_of_a_trial_that_took_its_time_is_announced():
    rig = HeldRig()
    with attending(rig) as attendant:
        assert attendant.begin(trial()).verdict == "accepted"
        assert not attendant.announced.acquire(blocking=False)
        rig.go.set()
        assert attendant.announced.acquire(timeout=60.0)


def test_a_rig_that_was_quick_is_awaited_and_its_record_is_the_answer():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        while not isinstance(state := attendant.begin(trial(len(rig.asked))), bytes):
            attendant.wait()  # the first is not awaited: nothing is known of the rig
        assert frame.decode(state).trial_id == rig.asked[-1].trial_id
    assert len(rig.asked) > 1


def test_a_rig_that_was_quick_and_is_not_any_more_is_told_of_by_the_other_thread():
    rig = HeldRig()
    with attending(rig) as attendant:
        attendant._prompt = True
        slow = threading.Thread(target=attendant.begin, args=(trial(),))
        slow.start()
        while not rig.asked:
            time.sleep(0.001)
        assert attendant.begin(trial()).verdict == "known"
        rig.go.set()
        slow.join()
        assert attendant.announced.acquire(timeout=60.0)
        assert isinstance(attendant.begin(trial()), bytes)
    assert rig.asked == [trial()]


def test_another_request_under_the_same_id_is_refused_and_not_run():
    rig = ScriptedRig()
    with attending(rig) as attendant:
        attendant.begin(trial())
        attendant.wait()
        answer = attendant.begin(trial(step_N=6.0))
        assert (answer.verdict, answer.error) == ("refused", "RigError")
        assert attendant.result(trial().trial_id, "0").verdict == "refused"
    assert rig.asked == [trial()]


def test_a_second_trial_and_new_gains_are_told_that_the_rig_is_busy_and_with_what():
    rig = HeldRig()
    with attending(rig) as attendant:
        attendant.begin(trial())
        for answer in (
            attendant.begin(trial(1)),
            attendant.set_gains(SetGains(replace(GAINS, P=2.0))),
        ):
            assert answer.verdict == "busy"
            assert trial().trial_id in answer.sentence
        assert attendant.status().trial_id == trial().trial_id
        rig.go.set()
        attendant.wait()
        attendant.begin(trial(1))
        attendant.wait()
        assert attendant.status().ended == 2
    assert rig.asked == [trial(), trial(1)]


def test_while_a_trial_runs_the_description_is_that_of_the_rig_at_rest():
    rig = HeldRig()
    with attending(rig) as attendant:
        at_rest = attendant.describe()
        attendant.begin(trial())
        assert attendant.describe() == at_rest
        rig.go.set()


def test_a_trial_cancelled_before_it_began_is_not_run():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant._rig_free.acquire()  # keeps the trial from beginning
        attendant.begin(trial())
        assert attendant.cancel(Cancel()).trial_id == trial().trial_id
        attendant._rig_free.release()
        attendant.wait()
        record = frame.decode(attendant.result(trial().trial_id, digest(trial())))
        assert record.outcome is Outcome.CANCELLED
        assert record.gains == rig.describe().gains
        assert record.time_s.size == 0
    assert rig.asked == []


def test_cancel_names_the_trial_until_it_has_ended_and_spares_the_next():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant.begin(trial())
        while attendant.cancel(Cancel(trial().trial_id)).trial_id:
            time.sleep(0.001)
        attendant.begin(trial(1))
        assert attendant.cancel(Cancel(trial().trial_id)) == Answer("accepted")
        assert attendant.status().trial_id == trial(1).trial_id


def test_closing_stops_the_trial_under_way_and_takes_in_no_more():
    rig = ScriptedRig(duration_s=60.0)
    with attending(rig) as attendant:
        attendant.begin(trial())
        attendant.close()
        assert attendant.status().trial_id == ""
        answer = attendant.begin(trial(1))
        assert (answer.verdict, answer.error) == ("refused", "RigError")


def test_what_the_rigs_program_raises_is_the_result_of_the_trial(caplog):
    with attending(ScriptedRig(broken)) as attendant:
        attendant.begin(trial())
        attendant.wait()
        answer = attendant.result(trial().trial_id, digest(trial()))
        assert (answer.verdict, answer.error) == ("refused", "RigError")
        assert "ZeroDivisionError: no answer to 0" in answer.sentence
        assert attendant.status().trial_id == ""
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert "broken" in caplog.text


def test_a_rig_that_cannot_be_stopped_says_so_each_time_it_is_asked_to():
    rig = HeldRig()
    rig.abort = lambda: broken(trial(7))
    with attending(rig) as attendant:
        attendant.begin(trial())
        while (answer := attendant.cancel(Cancel())).verdict == "accepted":
            time.sleep(0.001)
        assert "no answer to 7" in answer.sentence
        assert attendant.cancel(Cancel()).verdict == "accepted"
        rig.go.set()
        attendant.wait()
        assert attendant.cancel(Cancel()) == Answer("accepted")


def test_a_trial_too_long_for_a_frame_is_refused_before_it_moves_anything():
    limits = replace(description().limits, duration_max_s=1e6)
    rig = ScriptedRig(limits=limits)
    with attending(rig) as attendant:
        answer = attendant.begin(trial(duration_s=1e4))
        assert answer.error == "InvalidInput"
        assert "shorter" in answer.sentence
    assert rig.asked == []


def test_the_ledger_lets_go_of_records_before_it_forgets_that_they_ran():
    ledger = Ledger(frames_max_bytes=25, trials_max=4)
    for number in range(5):
        ledger.add(str(number), "d")
        assert ledger.find(str(number), "d").verdict == "known"
        ledger.end(str(number), bytes(10))
    assert ledger.find("0", "d") is None
    for number in "12":
        state = ledger.find(number, "d")
        assert (state.verdict, state.error) == ("refused", "RigError")
        assert "has run" in state.sentence
    assert ledger.find("3", "d") == ledger.find("4", "d") == bytes(10)


def test_the_ledger_holds_the_last_record_however_large():
    ledger = Ledger(frames_max_bytes=25)
    for number in range(3):
        ledger.add(str(number), "d")
        ledger.end(str(number), bytes(100))
    assert ledger.find("1", "d").verdict == "refused"
    assert ledger.find("2", "d") == bytes(100)
