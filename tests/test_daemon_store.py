"""What the daemon's store holds comes back, and does not grow without end."""

from dataclasses import asdict, replace

import pytest

from estune.core.control_chart import ChartSignal
from estune.daemon.events import EventKind
from estune.daemon.store import DaemonStore
from estune.daemon.supervisor_state import GainSet, Goal, SupervisorState
from estune.errors import JournalError
from estune.trial import TrialRequest
from tests.support_daemon import ORIGINAL
from tests.support_rigs import description, response, same

REQUEST = TrialRequest("run", 0, ORIGINAL, description().step)


def test_a_store_comes_back_as_it_was_left(tmp_path):
    candidate = replace(ORIGINAL, P=0.1 + 0.2)
    life = SupervisorState(Goal.HOLD, GainSet.ORIGINAL, "found so", paused="asked to")
    store = DaemonStore.open(tmp_path, "drum")
    with store.writing():
        store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
        store.set_gains(GainSet.CANDIDATE, candidate, "better")
        store.life = life
        noted = store.note(EventKind.BETTER, "better", {"cost": 0.5})
    record = response(REQUEST)
    store.ask_check(REQUEST)
    assert store.next_check() == (0, 0)
    store.tell_check(REQUEST, record, 1.5, ChartSignal.STEADY)
    identity = store.identity
    store.close()
    store = DaemonStore.open(tmp_path, "drum")
    try:
        assert store.life == life
        assert store.gains() == {GainSet.ORIGINAL: ORIGINAL, GainSet.CANDIDATE: candidate}
        assert store.events(0, 9) == store.events(-1, 9) == [noted]
        assert store.identity == identity
        assert same(store.check_record(0), record)
        assert store.next_check() == (1, 0)
        with pytest.raises(JournalError, match="no record of check trial 1"):
            store.check_record(1)
    finally:
        store.close()


def test_a_store_of_the_first_version_is_gone_on_with(tmp_path):
    store = DaemonStore.open(tmp_path, "drum")
    life = SupervisorState(Goal.HOLD, GainSet.ACCEPTED, "better")
    with store.writing():
        store.put("life", asdict(life) | {"wanted": "candidate"})
        store._connection.execute("PRAGMA user_version=1")
    store.close()
    store = DaemonStore.open(tmp_path, "drum")
    assert store.life == life
    store.close()


def test_what_is_written_in_a_block_that_fails_is_not_there(tmp_path):
    store = DaemonStore.open(tmp_path, "drum")

    def half() -> None:
        with store.writing():
            store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
            store.put("rig", object())

    with pytest.raises(TypeError):
        half()
    assert store.gains() == {}
    assert store.fact("rig") == "drum"
    store.close()


def test_a_store_does_not_grow_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.daemon.store.RECORDS_KEPT", 10)
    monkeypatch.setattr("estune.daemon.store.ROWS_KEPT", 20)
    store, record, sizes = DaemonStore.open(tmp_path, "drum"), response(REQUEST), []
    store._connection.execute("PRAGMA synchronous=OFF")
    for number in range(300):
        request = replace(REQUEST, number=number)
        store.ask_check(request)
        store.tell_check(request, record, 1.0, ChartSignal.STEADY)
        store.note(EventKind.SUSPECT, "far off", {})
        sizes.append(store._connection.execute("PRAGMA page_count").fetchone()[0])
    assert len(store.checks(100)) == len(store.events(0, 100)) == 20
    assert sizes[-1] == sizes[100]
    store.close()
