"""Files that are full, read-only, old or cut off in the middle: said in one line, nothing lost."""

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from estune import api
from estune.errors import JournalError
from estune.run import journal
from estune.run.journal import FILE_NAME, Journal
from estune.support import sqlite
from tests.support_runs import ArithmeticRig

OLD = Path(__file__).parent / "assets" / "journal_v1.sqlite"
"""Written by the first version of the schema: `otis`, 12 search trials, 2 repeats."""

_TUNE = """
import resource, sys, estune
from estune.errors import EstuneError
from tests.support_runs import ArithmeticRig
if len(sys.argv) > 2:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    estune.tune(ArithmeticRig(), trials=300, folder=sys.argv[1], run="run", watch=None)
except EstuneError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@contextmanager
def small_disk(folder: Path, size: str):
    """A file system of that size; skips where this user may not make one."""
    folder.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder],
        capture_output=True,
        check=False,
    )
    if made.returncode:
        pytest.skip("this user may not mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def tune_until_it_fails(folder: Path, *limit_bytes: str) -> str:
    """What a tuning in another process says when it cannot go on."""
    ended = subprocess.run(
        [sys.executable, "-c", _TUNE, folder, *limit_bytes],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == JournalError.exit_code, ended.stderr
    said = ended.stdout.strip()
    assert "\n" not in said
    return said


def committed(folder: Path) -> list[tuple]:
    with Journal.open(folder) as book:
        return [(e.number, e.gains, e.cost) for e in book.entries() if e.outcome is not None]


def undisturbed(trials: int) -> list[tuple]:
    whole = api.tune(ArithmeticRig(), trials=trials, journal=False, run="run", watch=None)
    return [(e.number, e.gains, e.cost) for e in whole.entries]


def test_a_full_disk_is_said_and_what_was_told_before_is_whole(tmp_path):
    with small_disk(tmp_path / "disk", "600k") as disk:
        said = tune_until_it_fails(disk)
        assert "full" in said
        assert "estune resume" in said
        kept = committed(disk / "run")
        roomy = shutil.copytree(disk / "run", tmp_path / "roomy")
    assert len(kept) > 10
    resumed = api.resume(roomy, ArithmeticRig(), watch=None)
    assert [(e.number, e.gains, e.cost) for e in resumed.entries] == undisturbed(300)


def test_a_file_that_may_not_grow_is_said_and_what_was_told_before_is_whole(tmp_path):
    said = tune_until_it_fails(tmp_path, "400000")
    assert "estune resume" in said
    kept = committed(tmp_path / "run")
    assert len(kept) > 10
    assert kept == undisturbed(300)[: len(kept)]


def old_run(tmp_path: Path) -> Path:
    folder = tmp_path / "old"
    folder.mkdir()
    shutil.copy(OLD, folder / FILE_NAME)
    return folder


def test_a_disk_that_turns_read_only_is_said_and_the_run_can_still_be_read(tmp_path):
    with small_disk(tmp_path / "disk", "4m") as disk:
        shutil.copytree(old_run(tmp_path), disk / "run")
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        assert len(committed(disk / "run")) == 22
        with pytest.raises(JournalError, match="can be written"):
            Journal.open(disk / "run", write=True)
        with pytest.raises(JournalError, match="can be written"):
            api.tune(ArithmeticRig(), folder=disk, run="new", watch=None)


def test_a_journal_of_the_first_schema_is_read_and_replayed(tmp_path):
    result = api.load(old_run(tmp_path))
    assert result.success
    assert [e.number for e in result.entries] == list(range(22))
    # The same run made now: every proposal and cost as they were then, but for the last bits, in
    # which processors differ.
    now = api.tune(
        *(ArithmeticRig(),),
        tuner="otis",
        trials=12,
        repeats=2,
        journal=False,
        run="old",
        watch=None,
    )
    then, today = (
        np.array([[*e.gains.as_tuple(), e.cost] for e in found.entries]) for found in (result, now)
    )
    np.testing.assert_allclose(today, then, rtol=1e-12)


LATER = (*journal.VERSIONS, "ALTER TABLE trial ADD COLUMN weather TEXT; DELETE FROM run WHERE 0")
"""What a next version of the schema might be."""


@pytest.mark.parametrize("write", [True, False])
def test_an_older_schema_is_brought_up_to_date_when_it_is_opened(write, tmp_path, monkeypatch):
    folder = old_run(tmp_path)
    before = committed(folder)
    monkeypatch.setattr(journal, "VERSIONS", LATER)
    with Journal.open(folder, write=write) as book:
        assert sqlite.version(book._connection) == len(LATER)
        assert book._connection.execute("SELECT weather FROM trial").fetchall() == [(None,)] * 22
    assert committed(folder) == before


def test_a_migration_that_is_cut_off_leaves_the_old_file(tmp_path, monkeypatch):
    folder = old_run(tmp_path)
    before = committed(folder)
    monkeypatch.setattr(journal, "VERSIONS", (*LATER, "ALTER TABLE nothing ADD COLUMN at_all"))
    with pytest.raises(JournalError, match="nothing"):
        Journal.open(folder, write=True)
    monkeypatch.undo()
    with Journal.open(folder) as book:
        assert sqlite.version(book._connection) == 1
    assert committed(folder) == before


def test_a_lock_says_who_holds_it_and_dies_with_its_holder(tmp_path):
    with sqlite.lock(tmp_path / "lock", "the book"):
        with pytest.raises(JournalError, match=f"the book .*process {os.getpid()} of "):
            sqlite.lock(tmp_path / "lock", "the book")
        assert sqlite.being_written(tmp_path / "lock")
    assert not sqlite.being_written(tmp_path / "lock")
    sqlite.lock(tmp_path / "lock", "the book").close()


def test_a_transaction_that_fails_leaves_nothing(tmp_path):
    with ExitStack() as opened:
        connection = sqlite.connect(opened, tmp_path / "file", "rwc")
        connection.execute("CREATE TABLE number (n)")
        statements = ("INSERT INTO number VALUES (1)", "INSERT INTO nothing VALUES (1)")
        with pytest.raises(sqlite3.OperationalError), sqlite.transaction(connection):
            [connection.execute(statement) for statement in statements]
        assert connection.execute("SELECT * FROM number").fetchall() == []
