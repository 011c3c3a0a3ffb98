"""Files on full or read-only disks, of old schemas or torn: one-line message, no loss."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from estune import api
from estune.errors import JournalError
from estune.run import journal
from estune.run.journal import FILE_NAME, Journal
from estune.support.sqlite import FileKind, SqliteFile, has_writer
from tests.support_runs import ArithmeticRig

OLD = Path(__file__).parent / "assets" / "journal_0_1_0.sqlite"
"""Written by version 0.1.0: `otis`, 12 search trials, 2 repeats."""

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
    """Mounts a file system of the given size; skips the test without permission to mount."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("this user may not mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def tune_until_it_fails(folder: Path, *limit_bytes: str) -> str:
    """Message of a tuning in another process that cannot continue."""
    ended = subprocess.run(
        [sys.executable, "-c", _TUNE, folder, *limit_bytes],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == JournalError.exit_code, ended.stderr
    message = ended.stdout.strip()
    assert "\n" not in message
    return message


def committed_rows_of(folder: Path) -> list[tuple]:
    with Journal.open(folder) as book:
        return [(e.number, e.gains, e.cost) for e in book.entries() if e.outcome is not None]


def uninterrupted_rows(trials: int) -> list[tuple]:
    whole = api.tune(ArithmeticRig(), trials=trials, journal=False, run="run", watch=None)
    return [(e.number, e.gains, e.cost) for e in whole.entries]


@pytest.mark.slow
def test_full_disk_is_reported_and_committed_trials_stay_whole(tmp_path):
    with small_disk(tmp_path / "disk", "600k") as disk:
        message = tune_until_it_fails(disk)
        assert "full" in message
        assert "estune resume" in message
        committed_rows = committed_rows_of(disk / "run")
        roomy = shutil.copytree(disk / "run", tmp_path / "roomy")
    assert len(committed_rows) > 10
    resumed = api.resume(roomy, ArithmeticRig(), watch=None)
    assert [(e.number, e.gains, e.cost) for e in resumed.entries] == uninterrupted_rows(300)


@pytest.mark.slow
def test_file_size_limit_is_reported_and_committed_trials_stay_whole(tmp_path):
    message = tune_until_it_fails(tmp_path, "400000")
    assert "estune resume" in message
    committed_rows = committed_rows_of(tmp_path / "run")
    assert len(committed_rows) > 10
    assert committed_rows == uninterrupted_rows(300)[: len(committed_rows)]


def old_run(tmp_path: Path) -> Path:
    folder = tmp_path / "old"
    folder.mkdir()
    shutil.copy(OLD, folder / FILE_NAME)
    return folder


def test_read_only_disk_is_reported_and_leaves_the_run_readable(tmp_path):
    with small_disk(tmp_path / "disk", "4m") as disk:
        shutil.copytree(old_run(tmp_path), disk / "run")
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        assert len(committed_rows_of(disk / "run")) == 24
        with pytest.raises(JournalError, match="can be written"):
            Journal.open(disk / "run", write=True)
        with pytest.raises(JournalError, match="can be written"):
            api.tune(ArithmeticRig(), folder=disk, run="new", watch=None)


def test_journal_of_version_0_1_0_is_read_and_replayed(tmp_path):
    result = api.load(old_run(tmp_path))
    assert result.verdict.complete
    assert [e.number for e in result.entries] == list(range(24))
    # The run repeated now gives the proposals and costs of then, up to the last bits, in
    # which processors differ. How many repeats confirm them may change with the version.
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
        np.array([[*e.gains.as_tuple(), e.cost] for e in tuned.entries]) for tuned in (result, now)
    )
    both = min(len(then), len(today))
    assert both > sum(entry.phase != "confirm" for entry in result.entries)
    np.testing.assert_allclose(today[:both], then[:both], rtol=1e-12)


LATER = (*journal.VERSIONS, "ALTER TABLE trial ADD COLUMN weather TEXT; DELETE FROM run WHERE 0")
"""Journal of an imagined next version of the schema."""


def schema_of(book: Journal) -> int:
    return book._file.rows("PRAGMA user_version")[0][0]


@pytest.mark.parametrize("write", [True, False])
def test_journal_of_older_schema_is_migrated_when_opened(write, tmp_path, monkeypatch):
    folder = old_run(tmp_path)
    before = committed_rows_of(folder)
    monkeypatch.setattr(journal, "KIND", journal.KIND._replace(versions=LATER))
    with Journal.open(folder, write=write) as book:
        assert schema_of(book) == len(LATER)
        assert book._file.rows("SELECT weather FROM trial") == [(None,)] * 24
    assert committed_rows_of(folder) == before


def test_interrupted_migration_leaves_the_old_file(tmp_path, monkeypatch):
    folder = old_run(tmp_path)
    before = committed_rows_of(folder)
    broken = (*LATER, "ALTER TABLE nothing ADD COLUMN at_all")
    monkeypatch.setattr(journal, "KIND", journal.KIND._replace(versions=broken))
    with pytest.raises(JournalError, match="nothing"):
        Journal.open(folder, write=True)
    monkeypatch.undo()
    with Journal.open(folder) as book:
        assert schema_of(book) == len(journal.VERSIONS)
    assert committed_rows_of(folder) == before


KIND = FileKind("a book", ("CREATE TABLE number (n)",), "go on")


def test_lock_names_its_holder_and_ends_with_it(tmp_path):
    path = tmp_path / "book"
    with SqliteFile.open_writer(path, KIND) as file:
        assert file.is_new
        with pytest.raises(JournalError, match=f"book is .*process {os.getpid()} of "):
            SqliteFile.open_writer(path, KIND)
        assert has_writer(path, KIND)
    assert not has_writer(path, KIND)
    with SqliteFile.open_writer(path, KIND) as file:
        assert not file.is_new


def test_failed_transaction_writes_nothing_with_nested_blocks(tmp_path):
    def write_and_fail(file):
        with file.transaction():
            file.write_many("INSERT INTO number VALUES (?)", [(1,), (2,)])
            with file.transaction():
                file.write("INSERT INTO number VALUES (3)")
            assert len(file.rows("SELECT * FROM number")) == 3
            file.write("INSERT INTO nothing VALUES (1)")

    with SqliteFile.open_writer(tmp_path / "book", KIND) as file:
        with pytest.raises(JournalError, match="nothing"):
            write_and_fail(file)
        assert file.rows("SELECT * FROM number") == []


def test_refused_preparation_leaves_an_empty_file(tmp_path):
    def refuse(file):
        file.write("INSERT INTO number VALUES (1)")
        raise JournalError("of another rig")

    with pytest.raises(JournalError, match="of another rig"):
        SqliteFile.open_writer(tmp_path / "book", KIND, prepare=refuse)
    with SqliteFile.open_writer(tmp_path / "book", KIND) as file:
        assert file.is_new


def test_file_in_place_until_it_is_replaced(tmp_path):
    path = tmp_path / "book"
    with SqliteFile.open_writer(path, KIND) as file:
        assert file.is_in_place()
        path.rename(tmp_path / "elsewhere")
        assert not file.is_in_place()
