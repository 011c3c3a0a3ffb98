"""The rig's ledger: what was noted is known for ever, and what could not be written is said."""

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

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote.ledger import NOTHING, FileLedger, MemoryLedger
from estune.remote.state_machine.trials import TrialEvent, TrialState, after

SUBMIT, START, VOID = TrialEvent.SUBMIT, TrialEvent.START, TrialEvent.VOID


@pytest.fixture(params=["memory", "file"])
def ledger(request, tmp_path):
    made = MemoryLedger() if request.param == "memory" else FileLedger(tmp_path / "l", "reel")
    yield made
    made.close()


def opened(path: Path, **limits) -> FileLedger:
    return FileLedger(path / "l", "reel", **limits)


def states(ledger, *trial_ids: str) -> list[TrialState]:
    return [ledger.find(trial_id).state for trial_id in trial_ids]


# --- what both promise ---


def test_a_trial_is_known_by_its_digest_and_its_end(ledger):
    assert ledger.find("t") == NOTHING
    ledger.note("t", "d", SUBMIT)
    assert ledger.find("t") == ("d", TrialState.ACCEPTED, None, "", "")
    ledger.note("t", "d", START)
    ledger.end("t", b"frame")
    assert ledger.find("t") == ("d", TrialState.ENDED, b"frame", "", "")


def test_an_error_of_the_rig_is_the_end_of_a_trial(ledger):
    ledger.note("t", "d", SUBMIT, START)
    ledger.end("t", InvalidInput("20 N is too much"))
    assert ledger.find("t") == ("d", TrialState.FAILED, None, "InvalidInput", "20 N is too much")


@given(st.lists(st.sampled_from([SUBMIT, START, VOID]), max_size=6))
def test_a_ledger_notes_what_can_be_and_nothing_else(events):
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


def test_a_trial_that_was_voided_cannot_begin(ledger):
    ledger.note("t", "d", VOID)
    with pytest.raises(ProtocolError, match="void cannot start"):
        ledger.note("t", "d", SUBMIT, START)
    assert ledger.find("t").state is TrialState.VOID


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_records_are_let_go_of_long_before_it_is_forgotten_that_they_ran(kind, tmp_path):
    limits = {"frames_max_bytes": 25, "trials_max": 4}
    ledger = MemoryLedger(**limits) if kind == "memory" else opened(tmp_path, **limits)
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


def test_each_ledger_has_an_identity_of_its_own(ledger):
    assert ledger.identity not in ("", MemoryLedger().identity)


# --- what the file promises ---


def test_what_was_noted_is_known_after_a_restart(tmp_path):
    first = opened(tmp_path)
    first.note("accepted", "d", SUBMIT)
    first.note("running", "d", SUBMIT)
    first.note("running", "d", START)
    first.note("ended", "d", SUBMIT, START)
    first.end("ended", b"frame")
    first.note("void", "d", VOID)
    first.latch("smoke")
    first.close()
    second = opened(tmp_path)
    assert states(second, "accepted", "running", "ended", "void", "other") == [
        *(TrialState.NEVER_STARTED, TrialState.INTERRUPTED, TrialState.ENDED),
        *(TrialState.VOID, TrialState.UNKNOWN),
    ]
    assert second.find("ended").frame == b"frame"
    assert (second.identity, second.latched) == (first.identity, "smoke")
    second.latch("")
    second.close()
    third = opened(tmp_path)
    assert third.latched == ""
    third.close()


def test_a_ledger_killed_at_any_moment_knows_all_it_had_said_it_noted(tmp_path):
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
    said: dict[str, str] = {}
    for kill_after in (1, 40, 41, 99):
        process = subprocess.Popen(
            [sys.executable, "-c", text, str(tmp_path / str(kill_after))],
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent.parent,
        )
        said = {}
        for _ in range(kill_after):
            state, number = process.stdout.readline().split()
            said[number] = state
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        ledger = opened(tmp_path / str(kill_after))
        allowed = {
            "note": {TrialState.NEVER_STARTED, TrialState.INTERRUPTED, TrialState.ENDED},
            "running": {TrialState.INTERRUPTED, TrialState.ENDED},
            "ended": {TrialState.ENDED},
        }
        for number, state in said.items():
            entry = ledger.find(number)
            assert entry.state in allowed[state]
            if entry.state is TrialState.ENDED:
                assert entry.frame == bytes([int(number) % 256]) * 20_000
        ledger.close()


def test_a_second_process_is_kept_out(tmp_path):
    ledger = opened(tmp_path)
    with pytest.raises(RigError, match="is being written by another process"):
        opened(tmp_path)
    ledger.close()
    opened(tmp_path).close()


def test_a_ledger_serves_the_rig_it_was_begun_for(tmp_path):
    opened(tmp_path).close()
    with pytest.raises(RigError, match="is that of rig 'reel', not of 'drum'"):
        FileLedger(tmp_path / "l", "drum")
    opened(tmp_path).close()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(b"not a ledger" * 1000, "not a database|damaged"), (b"SQLite format 3\0" * 999, "damaged")],
)
def test_a_file_that_is_no_ledger_is_refused_and_left_alone(tmp_path, content, complaint):
    (tmp_path / "l").write_bytes(content)
    with pytest.raises(RigError, match=complaint):
        opened(tmp_path)
    assert (tmp_path / "l").read_bytes() == content


def test_a_ledger_of_a_newer_version_is_refused(tmp_path):
    opened(tmp_path).close()
    with sqlite3.connect(tmp_path / "l") as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()
    with pytest.raises(RigError, match="schema version 99"):
        opened(tmp_path)


@pytest.mark.skipif(os.getuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RigError, match=r"Permission denied|unable to open"):
        opened(tmp_path)


def full(ledger: FileLedger, *, is_full: bool) -> None:
    """Lets the file grow no further, as a full disk would; SQLite says the same of both."""
    (pages,) = ledger._writer.execute("PRAGMA page_count").fetchone()
    ledger._writer.execute(f"PRAGMA max_page_count={pages if is_full else 2**30}")


def test_a_full_disk_keeps_trials_out_and_loses_no_record(tmp_path):
    ledger = opened(tmp_path)
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
    again = opened(tmp_path)
    assert again.find("t").frame == bytes(100_000)
    assert again.find("next").state is TrialState.NEVER_STARTED
    again.close()


@pytest.mark.parametrize("replaced", [False, True])
def test_a_ledger_deleted_under_a_running_rig_takes_no_trial_in(replaced, tmp_path):
    book = opened(tmp_path)
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


def test_a_ledger_does_not_grow_without_end(tmp_path):
    ledger = opened(tmp_path, frames_max_bytes=200_000)
    sizes = []
    for number in range(300):
        ledger.note(str(number), "d", SUBMIT, START)
        ledger.end(str(number), bytes(20_000))
        sizes.append(sum(path.stat().st_size for path in tmp_path.iterdir()))
    assert sizes[-1] <= 1.1 * sizes[99]
    ledger.close()


def test_what_is_known_can_be_asked_while_the_disk_is_slow(tmp_path):
    ledger = opened(tmp_path)
    ledger.note("t", "d", SUBMIT)
    found = []
    with ledger._writing:  # as while a commit takes its time
        asking = threading.Thread(target=lambda: found.append(ledger.find("t").state))
        asking.start()
        asking.join(60.0)
    assert found == [TrialState.ACCEPTED]
    ledger.close()
