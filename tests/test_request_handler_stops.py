"""The request handler of a rig: what stops a trial, the emergency stop, telemetry."""

import threading
import time
from queue import SimpleQueue

import numpy as np
import pytest

from estune.errors import RigError
from estune.remote.ledger import FileLedger
from estune.remote.messages import Answer
from estune.remote.messages.commands import Cancel, Estop
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import Outcome, Telemetry, record_frame
from tests.support_rigs import ScriptedRig, broken
from tests.test_request_handler import GAINS, MINE, HeldRig, handle, handling, trial

# --- stopping ---


def test_cancel_before_the_start_prevents_the_trial():
    rig = ScriptedRig(duration_s=60.0)
    with handling(rig) as handler:
        handler._executor._rig_free.acquire()  # keeps the trial from beginning
        handler.begin(trial())
        assert handler.cancel(Cancel(MINE)).trial_id == trial().trial_id
        handler._executor._rig_free.release()
        handler.wait()
        record = record_frame.decode(handler.ask(trial()))
        assert record.outcome is Outcome.CANCELLED
        assert record.gains == rig.describe().gains
        assert record.time_s.size == 0
    assert rig.requests == []


def test_close_stops_the_active_trial_and_accepts_no_more():
    rig = ScriptedRig(duration_s=60.0)
    with handling(rig) as handler:
        handler.begin(trial())
        handler.close()
        assert handler.now.mode is Mode.CLOSED
        answer = handler.begin(trial(1))
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")


def test_cancel_reports_that_the_rig_cannot_be_stopped():
    rig = HeldRig()
    rig.abort = lambda: broken(trial(7))
    with handling(rig) as handler:
        handler.begin(trial())
        while (answer := handler.cancel(Cancel(MINE))).verdict is ReplyCode.ACCEPTED:
            time.sleep(0.001)
        assert "no answer to 7" in answer.sentence
        rig.go.set()
        handler.wait()
        assert handler.cancel(Cancel(MINE)) == Answer(ReplyCode.ACCEPTED)


def test_estop_waits_for_neither_trial_nor_disk(tmp_path):
    rig, ledger = HeldRig(), FileLedger(tmp_path / "ledger", "scripted")
    with handling(rig, ledger) as handler:
        handler.begin(trial())
        while not rig.requests:
            time.sleep(0.001)
        answers = SimpleQueue()
        with ledger._writing:  # as during a slow commit
            stopping = threading.Thread(
                target=handle, args=(handler.estop, Estop("fire"), answers.put)
            )
            stopping.start()
            assert answers.get(timeout=60.0).verdict is ReplyCode.ACCEPTED
            assert rig._latched == "fire"
        stopping.join()
        assert ledger.latched == "fire"
        rig.go.set()
    ledger.close()


def test_estop_that_fails_is_reported_and_latches(caplog):
    rig = ScriptedRig()
    rig.estop = lambda reason: broken(trial(7))  # noqa: ARG005  called by position
    with handling(rig) as handler:
        answer = handler.stop()
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
        assert handler.begin(trial()).verdict is ReplyCode.SAFE
    assert "emergency stop" in caplog.text
    assert rig.requests == []


def test_estop_at_the_start_of_a_trial_cancels_it():
    rig = ScriptedRig()
    run = rig.run
    with handling(rig) as handler:
        rig.run = lambda request: (handler.stop("smoke"), run(request))[1]
        handler.begin(trial())
        handler.wait()
        record = record_frame.decode(handler.ask(trial()))
    assert record.outcome is Outcome.CANCELLED
    assert record.reason.startswith("emergency stop: smoke (")
    assert rig.requests == []


def test_estop_persists_over_a_restart(tmp_path):
    for clear in (False, True):
        rig, ledger = ScriptedRig(), FileLedger(tmp_path / "ledger", "scripted")
        with handling(rig, ledger) as handler:
            if not clear:
                handler.stop("smoke")
                handler.stop("a later reason")
            assert handler.status().latched == "smoke"
            assert handler.begin(trial()).verdict is ReplyCode.SAFE
            with pytest.raises(RigError):
                rig.apply(GAINS)
            if clear:
                handler.reset()
                assert handler.begin(trial()).verdict is ReplyCode.ACCEPTED
        ledger.close()
    assert rig.requests == [trial()]


def test_estop_during_clear_holds():
    rig = ScriptedRig()
    cleared = rig.clear
    with handling(rig) as handler:
        handler.stop("smoke")
        rig.clear = lambda: (handler.stop("fire"), cleared())
        handler.reset()
        assert handler.now.latched == "fire"
        assert rig._latched == "fire"


# --- telemetry ---


class ShowingRig(ScriptedRig):
    """Rig whose telemetry has ten more samples at each call."""

    def telemetry(self, after):
        column = np.arange(after, after + 10.0)
        return Telemetry("run-00000", after, 200.0, column, column, column, column)


def test_telemetry_exists_only_during_a_trial_of_a_telemetry_source():
    rig = ShowingRig(duration_s=60.0)
    with handling(rig) as handler:
        assert handler.telemetry(0) is None
        handler.begin(trial())
        assert handler.telemetry(20).first_sample == 20
    with handling(ScriptedRig(duration_s=60.0)) as handler:
        handler.begin(trial())
        assert handler.telemetry(0) is None
