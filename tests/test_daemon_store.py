"""The daemon's store: its contents survive reopening, old files open, its size is bounded."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from estune.core.control_chart import ChartSignal, ChartState
from estune.core.gains import Gains
from estune.daemon.events import EventKind
from estune.daemon.store import DaemonStore
from estune.daemon.supervisor_state import GainSet, Goal, SupervisorState
from estune.trial import TrialRecord, TrialRequest, record_frame
from tests.support_daemon import ORIGINAL
from tests.support_rigs import description, response, same

ASSETS = Path(__file__).with_name("assets")
REQUEST = TrialRequest("run", 0, ORIGINAL, description().step)


def stored_record(store: DaemonStore, number: int) -> TrialRecord:
    ((frame,),) = store._file.rows("SELECT record FROM check_record WHERE number=?", number)
    return record_frame.decode(frame)


def test_store_holds_after_reopening_what_was_written(tmp_path):
    candidate = replace(ORIGINAL, P=0.1 + 0.2)
    state = SupervisorState(Goal.HOLD, GainSet.ORIGINAL, "found so", paused="asked to")
    store = DaemonStore.open(tmp_path, "drum")
    with store.transaction():
        store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
        store.set_gains(GainSet.CANDIDATE, candidate, "better")
        store.state = state
        event = store.add_event(EventKind.BETTER, "better", {"cost": 0.5})
    record = response(REQUEST)
    store.begin_check(REQUEST)
    assert store.next_check() == (0, 0)
    store.finish_check(REQUEST, record, 1.5, ChartSignal.STEADY, (1.0, 2.0))
    identity = store.identity
    store.close()
    store = DaemonStore.open(tmp_path, "drum")
    try:
        assert store.state == state
        assert store.gains() == {GainSet.ORIGINAL: ORIGINAL, GainSet.CANDIDATE: candidate}
        assert store.events(0, 9) == store.events(-1, 9) == [event]
        assert store.identity == identity
        assert same(stored_record(store, 0), record)
        assert store.checks(1)[0][-2:] == (1.0, 2.0)
        assert store.next_check() == (1, 0)
    finally:
        store.close()


def test_store_of_version_0_1_0_opens_with_all_it_holds(tmp_path):
    """Tuned, accepted, four checks, paused."""
    shutil.copy(ASSETS / "daemon_state" / "daemon.sqlite", tmp_path)
    store = DaemonStore.open(tmp_path, "drum")
    accepted = Gains(3.75726, 29.2887, 0.00388863, 0.0040028)
    assert store.state.home is GainSet.ACCEPTED
    assert (store.state.goal, store.state.paused) == (Goal.WATCH, "pause by the test")
    assert store.gains() == {GainSet.ORIGINAL: ORIGINAL, GainSet.ACCEPTED: accepted}
    assert store.fact("rig_facts")["name"] == "drum"
    assert ChartState(*store.fact("charts")["accepted"]).known == 6
    assert [check.sign for check in store.checks(100)] == ["steady"] * 4
    assert stored_record(store, 3).gains == accepted
    assert store.next_check() == (4, 0)
    kinds = (
        "started found backed_up tuning confirming better command gains paused stopping stopped"
    )
    assert [event.kind for event in store.events(0, 100)] == kinds.split()
    assert [command["verb"] for command in store.commands(9)] == ["accept", "pause"]
    store.close()


def test_transaction_that_fails_writes_nothing(tmp_path):
    store = DaemonStore.open(tmp_path, "drum")

    def half() -> None:
        with store.transaction():
            store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
            store.set_fact("rig", object())

    with pytest.raises(TypeError):
        half()
    assert store.gains() == {}
    assert store.fact("rig") == "drum"
    store.close()


def test_store_keeps_a_bounded_number_of_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.daemon.store.RECORDS_KEPT", 10)
    monkeypatch.setattr("estune.daemon.store.ROWS_KEPT", 20)
    store, record, sizes = DaemonStore.open(tmp_path, "drum"), response(REQUEST), []
    store._file._connection.execute("PRAGMA synchronous=OFF")
    for number in range(300):
        request = replace(REQUEST, number=number)
        store.begin_check(request)
        store.finish_check(request, record, 1.0, ChartSignal.STEADY, (0.5, 1.5))
        store.add_event(EventKind.SUSPECT, "far off", {})
        sizes.append(store._file._connection.execute("PRAGMA page_count").fetchone()[0])
    assert len(store.checks(100)) == len(store.events(0, 100)) == 20
    assert sizes[-1] == sizes[100]
    store.close()
