"""The journal: committed trials stay, and a run resumes from them bit for bit."""

import json
import shutil
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

import estune
from estune import api
from estune.errors import JournalError
from estune.run import loop
from estune.run.journal import FILE_NAME, Journal
from estune.run.planning import (
    description_from_json,
    description_to_json,
    make_plan,
    plan_from_json,
    plan_to_json,
)
from estune.run.tuning_run import TuningRun
from estune.support.sqlite import SqliteFile
from estune.trial import Outcome
from estune.tuners import TUNERS
from tests.support_runs import ArithmeticRig


class Killed(BaseException):
    """Stands for the death of the process."""


class Doomed:
    """Ends a run at a given event and copies its files as a kill would leave them."""

    def __init__(self, folder: Path, dies_at: int) -> None:
        self.folder, self.dies_at, self.events = folder, dies_at, 0

    def event(self) -> None:
        if self.events == self.dies_at:
            shutil.copytree(self.folder, self.folder.with_name("left"))
            raise Killed
        self.events += 1

    def around(self, function):
        def doomed(*args):
            self.event()
            result = function(*args)
            self.event()
            return result

        return doomed


def begin(folder: Path, tuner: str, rig: ArithmeticRig) -> TuningRun:
    plan = make_plan(
        *(rig.describe(), "run"),
        tuner=tuner,
        start=None,
        bounds=None,
        step=None,
        cost=None,
        trials=6,
        repeats=2,
    )
    facts = {"plan": plan_to_json(plan), "rig": description_to_json(rig.describe())}
    return loop.start(plan, rig.describe(), Journal.create(folder, facts))


def resume(folder: Path, rig: ArithmeticRig) -> TuningRun:
    with Journal.open(folder, write=True) as journal:
        journal._file.rows("PRAGMA synchronous=OFF")
        plan = plan_from_json(journal.fact("plan"))
        resumed = loop.replay(plan, description_from_json(journal.fact("rig")), journal)
        loop.run(resumed, rig)
    return resumed


def trace(entries) -> list[tuple]:
    return [(e.number, e.phase, e.gains.as_tuple(), e.cost) for e in entries]


@pytest.mark.parametrize(
    "tuner",
    [
        name if name == "least_squares_gradient" else pytest.param(name, marks=pytest.mark.slow)
        for name in TUNERS
    ],
)
def test_run_killed_at_any_event_resumes_as_if_undisturbed(tuner, tmp_path):
    # The events do not depend on the tuner: all of them for one, every fifth for the others.
    stride = 1 if tuner == "otis" else 5
    rig = ArithmeticRig()
    whole = begin(tmp_path / "whole", tuner, rig)
    loop.run(whole, rig)
    whole.journal.close()
    expected, dies_at, finished = trace(whole.entries), 0, False
    while not finished:
        folder = tmp_path / f"dies-{dies_at}" / "run"
        doomed, rig = Doomed(folder, dies_at), ArithmeticRig()
        dying = begin(folder, tuner, rig)
        # A killed process keeps its unsynced writes, so that syncing would only cost time.
        dying.journal._file.rows("PRAGMA synchronous=OFF")
        dying.journal.commit = doomed.around(dying.journal.commit)
        rig.run = doomed.around(rig.run)
        try:
            loop.run(dying, rig)
            finished = True
        except Killed:
            with Journal.open(folder.with_name("left")) as journal:
                requested_before = len(list(journal.entries()))
            again = ArithmeticRig()
            resumed = resume(folder.with_name("left"), again)
            assert trace(resumed.entries) == expected
            # No trial with a committed record runs again.
            assert len(again.requests) >= len(expected) - requested_before
            assert len(again.requests) <= len(expected) - max(requested_before - 1, 0)
        dying.journal.close()
        dies_at += stride
    assert doomed.events == 2 * len(expected) + 2 * (len(expected) + 1)


def test_journal_returns_records_bit_for_bit(tmp_path):
    rig = ArithmeticRig()
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    run.journal.close()
    with Journal.open(tmp_path / "run") as journal:
        for request in rig.requests:
            record, stored = ArithmeticRig().run(request), journal.record(request.trial_id)
            for column in ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags"):
                np.testing.assert_array_equal(getattr(stored, column), getattr(record, column))
            assert stored.gains == request.gains
            assert stored.outcome is Outcome.DONE


def test_loaded_result_equals_the_returned_one(tmp_path):
    returned = estune.tune(ArithmeticRig(), trials=11, folder=tmp_path, run="a", watch=None)
    loaded = estune.load(tmp_path / "a")
    assert loaded.verdict == returned.verdict
    assert loaded.to_frame().equals(returned.to_frame())


def test_tunings_that_begin_at_one_instant_have_a_run_each(tmp_path, monkeypatch):
    both, plan_json = Barrier(2, timeout=60.0), api.plan_to_json

    def together(plan):
        both.wait()  # each has looked for a name, and none has begun its journal
        return plan_json(plan)

    monkeypatch.setattr(api, "plan_to_json", together)

    def begun(_):
        return estune.tune(ArithmeticRig(), trials=11, folder=tmp_path, watch=None)

    with ThreadPoolExecutor(2) as pool:
        folders = {result.folder for result in pool.map(begun, range(2))}
    assert {folder.name for folder in folders} == {path.name for path in tmp_path.iterdir()}
    assert [estune.load(folder).plan.run for folder in folders] == [f.name for f in folders]
    assert len(folders) == 2


def test_journal_refuses_a_second_writer_but_no_reader(tmp_path):
    run = begin(tmp_path / "run", "otis", ArithmeticRig())
    with pytest.raises(JournalError, match="another process"):
        Journal.open(tmp_path / "run", write=True)
    with Journal.open(tmp_path / "run") as reader:
        assert reader.fact("plan")["run"] == "run"
    run.journal.close()


def test_journal_refuses_to_overwrite_a_run(tmp_path):
    begin(tmp_path / "run", "otis", ArithmeticRig()).journal.close()
    with pytest.raises(JournalError, match="holds a run already"):
        begin(tmp_path / "run", "otis", ArithmeticRig())


def test_journal_locked_by_another_program_is_reported_without_loss(tmp_path):
    rig = ArithmeticRig()
    run = begin(tmp_path / "run", "otis", rig)
    other = sqlite3.connect(tmp_path / "run" / FILE_NAME, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(JournalError, match=r"locked.*estune resume"):
        loop.run(run, rig)
    other.execute("ROLLBACK")
    other.close()
    run.journal.close()
    assert resume(tmp_path / "run", rig).session.phase is None


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "damaged"),
        (
            lambda path: path.write_bytes(b"not a database, but long enough to look at" * 50),
            "damaged",
        ),
        (lambda path: path.unlink(), "no run"),
    ],
    ids=["torn", "foreign", "missing"],
)
def test_damaged_journal_is_refused_with_a_remedy(damage, words, tmp_path):
    rig = ArithmeticRig()
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    run.journal.close()
    damage(tmp_path / "run" / FILE_NAME)
    with pytest.raises(JournalError, match=words):
        resume(tmp_path / "run", rig)


def test_journal_of_newer_version_is_refused_unchanged(tmp_path):
    begin(tmp_path / "run", "otis", ArithmeticRig()).journal.close()
    path = tmp_path / "run" / FILE_NAME
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()
    before = path.read_bytes()
    with pytest.raises(JournalError, match=r"version 99.*newer estune"):
        Journal.open(tmp_path / "run", write=True)
    assert path.read_bytes() == before


def test_full_disk_ends_the_run_and_keeps_committed_trials(tmp_path):
    rig = ArithmeticRig()
    run = begin(tmp_path / "run", "otis", rig)
    pages = run.journal._file.rows("PRAGMA page_count")[0][0]
    run.journal._file.rows(f"PRAGMA max_page_count={pages + 4}")
    with pytest.raises(JournalError, match=r"full.*estune resume"):
        loop.run(run, rig)
    run.journal.close()
    with Journal.open(tmp_path / "run") as journal:
        assert (
            sum(entry.outcome is not None for entry in journal.entries()) == len(run.entries) > 0
        )
    assert resume(tmp_path / "run", rig).session.phase is None


def test_run_that_a_full_disk_lets_not_begin_leaves_nothing_and_is_begun_again(
    tmp_path, monkeypatch
):
    def full(_file):
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(SqliteFile, "_migrate", full)
        with pytest.raises(JournalError, match="make room and begin again"):
            begin(tmp_path / "run", "otis", ArithmeticRig())
    assert not (tmp_path / "run" / FILE_NAME).exists()
    begin(tmp_path / "run", "otis", ArithmeticRig()).journal.close()


def test_changed_journal_is_refused_before_any_trial(tmp_path):
    rig = ArithmeticRig()
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    run.journal.close()
    with sqlite3.connect(tmp_path / "run" / FILE_NAME) as connection:
        connection.execute("UPDATE trial SET P = P * 1.01 WHERE number = 5")
    connection.close()
    trials_before = len(rig.requests)
    with pytest.raises(JournalError, match="not what the plan asks for"):
        resume(tmp_path / "run", rig)
    assert len(rig.requests) == trials_before


_TUNE = """
import sys, estune
from tests.support_runs import ArithmeticRig
options = {"trials": 150, "tolerance": 0.0, "run": "run", "watch": None}
estune.tune(ArithmeticRig(), folder=sys.argv[1], **options)
"""


@pytest.mark.slow
def test_killed_process_loses_no_committed_trial(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", _TUNE, tmp_path], cwd=Path(__file__).parents[1]
    )
    try:
        while process.poll() is None:
            try:
                with Journal.open(tmp_path / "run") as journal:
                    if sum(entry.outcome is not None for entry in journal.entries()) >= 60:
                        break
            except JournalError:
                continue
    finally:
        process.kill()
        process.wait()
    with Journal.open(tmp_path / "run") as journal:
        entries = [entry for entry in journal.entries() if entry.outcome is not None]
        assert json.dumps(journal.fact("status")) == '"running"'
    assert len(entries) >= 60
    resumed = estune.resume(tmp_path / "run", ArithmeticRig(), watch=None)
    options = {"trials": 150, "tolerance": 0.0, "run": "run", "watch": None}
    whole = estune.tune(ArithmeticRig(), journal=False, **options)
    assert trace(resumed.entries)[: len(entries)] == trace(entries)
    assert trace(resumed.entries) == trace(whole.entries)
