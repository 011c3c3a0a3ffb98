"""Ledger of a rig: durable entries, transitions, limits, and errors of the file."""

import os
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.gains import Gains
from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote.ledger import NOTHING, FileLedger, MemoryLedger
from estune.remote.state_machine.trials import TrialEvent, TrialState, after

ORIGINAL, LIVE = Gains(0.1, 2.0, 0.003, 0.0), Gains(0.2, 3.0, 0.004, 0.01)
SUBMIT, START, VOID = TrialEvent.SUBMIT, TrialEvent.START, TrialEvent.VOID


@pytest.fixture(params=["memory", "file"])
def ledger(request, tmp_path):
    ledger = MemoryLedger() if request.param == "memory" else FileLedger(tmp_path / "l", "reel")
    yield ledger
    ledger.close()


def open_ledger(path: Path, **limits) -> FileLedger:
    return FileLedger(path / "l", "reel", **limits)


def states(ledger, *trial_ids: str) -> list[TrialState]:
    return [ledger.find(trial_id).state for trial_id in trial_ids]


# --- both ledgers ---


def test_find_returns_digest_state_and_frame(ledger):
    assert ledger.find("t") == NOTHING
    ledger.note("t", "d", SUBMIT)
    assert ledger.find("t") == ("d", TrialState.ACCEPTED, None, "", "")
    ledger.note("t", "d", START)
    ledger.end("t", b"frame")
    assert ledger.find("t") == ("d", TrialState.ENDED, b"frame", "", "")


def test_end_with_an_error_stores_it(ledger):
    ledger.note("t", "d", SUBMIT, START)
    ledger.end("t", InvalidInput("20 N is too much"))
    assert ledger.find("t") == ("d", TrialState.FAILED, None, "InvalidInput", "20 N is too much")


@given(st.lists(st.sampled_from([SUBMIT, START, VOID]), max_size=6))
def test_note_accepts_possible_events_only(events):
    ledger, state = MemoryLedger(), TrialState.UNKNOWN
    for event in events:
        try:
            expected = after(state, event)
        except ProtocolError:
            with pytest.raises(ProtocolError):
                ledger.note("t", "d", event)
        else:
            ledger.note("t", "d", event)
            state = expected
        assert ledger.find("t").state is state


def test_note_of_a_start_after_void_is_an_error(ledger):
    ledger.note("t", "d", VOID)
    with pytest.raises(ProtocolError, match="void cannot start"):
        ledger.note("t", "d", SUBMIT, START)
    assert ledger.find("t").state is TrialState.VOID


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_frames_are_deleted_long_before_trial_ids(kind, tmp_path):
    limits = {"frames_max_bytes": 25, "trials_max": 4}
    ledger = MemoryLedger(**limits) if kind == "memory" else open_ledger(tmp_path, **limits)
    for number in range(6):
        ledger.note(str(number), "d", SUBMIT, START)
        ledger.end(str(number), bytes(10))
    assert [ledger.find(str(n)).frame for n in (4, 5)] == [bytes(10)] * 2
    ended = TrialState.ENDED
    assert states(ledger, *"012345") == [*[TrialState.UNKNOWN] * 2, *[ended] * 4]
    assert ledger.find("3").frame is None
    ledger.note("big", "d", SUBMIT, START)
    ledger.end("big", bytes(100))
    assert ledger.find("big").frame == bytes(100)
    assert ledger.find("5").frame is None
    ledger.close()


def test_records_of_several_trials_are_kept_by_default(ledger):
    """A record of 10 s at 1 kHz takes half a megabyte."""
    for trial_id in "0123":
        ledger.note(trial_id, "d", SUBMIT, START)
        ledger.end(trial_id, bytes(500_000))
    assert all(ledger.find(trial_id).frame for trial_id in "0123")


def test_identity_is_unique(ledger):
    assert ledger.identity not in ("", MemoryLedger().identity)


# --- the ledger on disk ---


def test_entries_persist_over_a_restart(tmp_path):
    first = open_ledger(tmp_path)
    first.note("accepted", "d", SUBMIT)
    first.note("running", "d", SUBMIT)
    first.note("running", "d", START)
    first.note("ended", "d", SUBMIT, START)
    first.end("ended", b"frame")
    first.note("void", "d", VOID)
    first.latch("smoke")
    first.keep_original(LIVE, ORIGINAL)
    first.close()
    second = open_ledger(tmp_path)
    assert states(second, "accepted", "running", "ended", "void", "other") == [
        *(TrialState.NEVER_STARTED, TrialState.INTERRUPTED, TrialState.ENDED),
        *(TrialState.VOID, TrialState.UNKNOWN),
    ]
    assert second.find("ended").frame == b"frame"
    assert (second.identity, second.latched) == (first.identity, "smoke")
    assert (second.original_of(LIVE), second.original_of(ORIGINAL)) == (ORIGINAL, None)
    second.latch("")
    second.keep_original(LIVE, None)
    second.close()
    third = open_ledger(tmp_path)
    assert (third.latched, third.original_of(LIVE)) == ("", None)
    third.close()


def test_entries_survive_kill_at_any_moment(tmp_path):
    text = """
import sys
from pathlib import Path
from estune.remote.ledger import FileLedger
from estune.remote.state_machine.trials import TrialEvent
ledger = FileLedger(Path(sys.argv[1]) / "l", "reel", frames_max_bytes=10**9)
for number in range(10**6):
    ledger.note(str(number), "d", TrialEvent.SUBMIT)
    print("note", number, flush=True)
    ledger.note(str(number), "d", TrialEvent.START)
    print("running", number, flush=True)
    ledger.end(str(number), bytes([number % 256]) * 20_000)
    print("ended", number, flush=True)
"""
    states: dict[str, str] = {}
    for kill_after in (1, 40, 41, 99):
        process = subprocess.Popen(
            [sys.executable, "-c", text, str(tmp_path / str(kill_after))],
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent.parent,
        )
        states = {}
        for _ in range(kill_after):
            state, number = process.stdout.readline().split()
            states[number] = state
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        ledger = open_ledger(tmp_path / str(kill_after))
        allowed = {
            "note": {TrialState.NEVER_STARTED, TrialState.INTERRUPTED, TrialState.ENDED},
            "running": {TrialState.INTERRUPTED, TrialState.ENDED},
            "ended": {TrialState.ENDED},
        }
        for number, state in states.items():
            entry = ledger.find(number)
            assert entry.state in allowed[state]
            if entry.state is TrialState.ENDED:
                assert entry.frame == bytes([int(number) % 256]) * 20_000
        ledger.close()


def test_second_writer_is_refused(tmp_path):
    ledger = open_ledger(tmp_path)
    with pytest.raises(RigError, match="is being written by another process"):
        open_ledger(tmp_path)
    ledger.close()
    open_ledger(tmp_path).close()


def test_ledger_of_another_rig_is_refused(tmp_path):
    open_ledger(tmp_path).close()
    with pytest.raises(RigError, match="is that of rig 'reel', not of 'drum'"):
        FileLedger(tmp_path / "l", "drum")
    open_ledger(tmp_path).close()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(b"not a ledger" * 1000, "not a database|damaged"), (b"SQLite format 3\0" * 999, "damaged")],
)
def test_file_that_is_no_ledger_is_refused_and_unchanged(tmp_path, content, complaint):
    (tmp_path / "l").write_bytes(content)
    with pytest.raises(RigError, match=complaint):
        open_ledger(tmp_path)
    assert (tmp_path / "l").read_bytes() == content


def test_ledger_of_a_newer_version_is_refused(tmp_path):
    open_ledger(tmp_path).close()
    with sqlite3.connect(tmp_path / "l") as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()
    with pytest.raises(RigError, match="schema version 99"):
        open_ledger(tmp_path)


@pytest.mark.skipif(os.getuid() == 0, reason="root may write anywhere")
def test_folder_without_write_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RigError, match=r"Permission denied|unable to open"):
        open_ledger(tmp_path)


def full(ledger: FileLedger, *, is_full: bool) -> None:
    """Limits the file size; SQLite then reports the error of a full disk."""
    ((pages,),) = ledger._file.rows("PRAGMA page_count")
    ledger._file.rows(f"PRAGMA max_page_count={pages if is_full else 2**30}")


def test_full_disk_refuses_trials_and_loses_no_record(tmp_path):
    ledger = open_ledger(tmp_path)
    ledger.note("t", "d", SUBMIT, START)
    full(ledger, is_full=True)
    ledger.end("t", bytes(100_000))
    assert ledger.find("t").frame == bytes(100_000)
    with pytest.raises(RigError, match="the disk is full; make room"):
        ledger.note("next", "d", SUBMIT)
    assert ledger.find("next") == NOTHING
    full(ledger, is_full=False)
    ledger.note("next", "d", SUBMIT)
    ledger.close()
    again = open_ledger(tmp_path)
    assert again.find("t").frame == bytes(100_000)
    assert again.find("next").state is TrialState.NEVER_STARTED
    again.close()


@pytest.mark.parametrize("replaced", [False, True])
def test_ledger_deleted_in_use_refuses_trials(replaced, tmp_path):
    book = open_ledger(tmp_path)
    try:
        book.note("a", "d", SUBMIT, START)
        (tmp_path / "l").unlink()
        if replaced:
            (tmp_path / "l").touch()
        with pytest.raises(RigError, match="was deleted or replaced while it was in use"):
            book.note("b", "d", SUBMIT)
        book.end("a", b"the record")
        assert book.find("a").frame == b"the record"
        assert states(book, "b") == [TrialState.UNKNOWN]
    finally:
        book.close()


def test_ledger_size_is_bounded(tmp_path):
    ledger = open_ledger(tmp_path, frames_max_bytes=200_000)
    sizes = []
    for number in range(300):
        ledger.note(str(number), "d", SUBMIT, START)
        ledger.end(str(number), bytes(20_000))
        sizes.append(sum(path.stat().st_size for path in tmp_path.iterdir()))
    assert sizes[-1] <= 1.1 * sizes[99]
    ledger.close()


def test_find_does_not_wait_for_a_slow_disk(tmp_path):
    ledger = open_ledger(tmp_path)
    ledger.note("t", "d", SUBMIT)
    entries = []
    with ledger._writing:  # as during a slow commit
        asking = threading.Thread(target=lambda: entries.append(ledger.find("t").state))
        asking.start()
        asking.join(60.0)
    assert entries == [TrialState.ACCEPTED]
    ledger.close()
