"""Long runs: compressed records, a ring of them, snapshots, and a disk that fills up."""

import shutil
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from estune.errors import JournalError, ProtocolError
from estune.run import disk_space, loop, snapshot
from estune.run.compressed_frame import compress, decompress
from estune.run.journal import FILE_NAME, CompletedTrial, Journal
from estune.run.phase import Phase
from estune.run.session import next_request
from estune.support import sqlite
from estune.trial import TrialRequest, record_frame
from estune.tuners import TUNERS
from tests.support_runs import ArithmeticRig
from tests.test_journal import begin, resume, trace

OLD = Path(__file__).parent / "assets" / "journal_v1.sqlite"


def request(number: int) -> TrialRequest:
    rig = ArithmeticRig().describe()
    return TrialRequest("run", number, rig.gains, rig.step)


@pytest.fixture
def frame() -> bytes:
    return record_frame.encode(ArithmeticRig().run(request(3)))


def test_compressed_frame_is_smaller_and_restored_bit_for_bit(frame):
    assert decompress(compress(frame)) == frame
    assert len(compress(frame)) < 0.6 * len(frame)


@pytest.mark.parametrize("values", [np.nan, np.inf, -0.0, 5e-324])
def test_compressed_frame_keeps_special_numbers(values):
    record = ArithmeticRig().run(request(0))
    record.tension_N[::3] = values
    frame = record_frame.encode(record)
    assert decompress(compress(frame)) == frame


def test_damaged_compressed_frame_is_refused(frame):
    data = compress(frame)
    for place in range(0, len(data), 7):
        torn = bytearray(data)
        torn[place] ^= 1 << place % 8
        with suppress(ProtocolError):  # or in a bit that has no meaning
            assert decompress(bytes(torn)) == frame
    for end in range(len(data)):
        with pytest.raises(ProtocolError):
            record_frame.decode(decompress(data[:end]))


def interrupted(folder: Path, tuner: str, trials: int) -> None:
    """A run that ends before its trial of that number."""

    class Stopping(ArithmeticRig):
        def run(self, request):
            if request.number == trials:
                raise KeyboardInterrupt
            return super().run(request)

    run = begin(folder, tuner, ArithmeticRig())
    run.journal._file.rows("PRAGMA synchronous=OFF")
    with pytest.raises(loop.Stopped):
        loop.run(run, Stopping())
    run.journal.close()


@pytest.mark.parametrize("tuner", TUNERS)
def test_run_resumed_from_a_snapshot_proposes_as_a_full_replay(tuner, tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "INTERVAL", 4)
    interrupted(tmp_path / "run", tuner, 11)
    shutil.copytree(tmp_path / "run", tmp_path / "whole")
    requests = []
    monkeypatch.setattr(
        loop, "next_request", lambda session: requests.append(1) or next_request(session)
    )
    with Journal.open(tmp_path / "run") as journal:
        assert journal.snapshot()[0] == 8
    resumed = resume(tmp_path / "run", ArithmeticRig())
    replayed = len(requests) - (len(resumed.entries) - 11) - 1
    assert replayed == 4  # three trials after the snapshot, and the one under way
    monkeypatch.setattr(snapshot, "read", lambda *_: (0, None))
    whole = resume(tmp_path / "whole", ArithmeticRig())
    assert trace(resumed.entries) == trace(whole.entries)
    assert repr(resumed.session) == repr(whole.session)


def change(statement: str):
    def run(folder: Path) -> None:
        with Journal.open(folder, write=True) as journal:
            journal._file.write(statement)

    return run


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE snapshot SET version = 'another'",
        "UPDATE snapshot SET state = x'80054b012e'",
        "UPDATE snapshot SET state = x'636f730a73797374656d0a285327747275650a745274522e'",
        "UPDATE snapshot SET trials = 10000",
    ],
    ids=["other version", "no session", "a call", "too long"],
)
def test_unusable_snapshot_is_ignored(statement, tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "INTERVAL", 4)
    interrupted(tmp_path / "run", "otis", 11)
    shutil.copytree(tmp_path / "run", tmp_path / "whole")
    change(statement)(tmp_path / "run")
    resumed, whole = (resume(tmp_path / name, ArithmeticRig()) for name in ("run", "whole"))
    assert trace(resumed.entries) == trace(whole.entries)


def test_trials_changed_before_a_snapshot_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "INTERVAL", 4)
    interrupted(tmp_path / "run", "otis", 11)
    change("UPDATE trial SET P = P * 1.01 WHERE number = 5")(tmp_path / "run")
    with pytest.raises(JournalError, match="not what the plan asks for"):
        resume(tmp_path / "run", ArithmeticRig())


def test_ring_keeps_latest_records_and_all_costs(tmp_path):
    rig = ArithmeticRig()
    with Journal.create(tmp_path / "run", {"records_max": 5}) as journal:
        for number in range(20):
            phase = Phase.BASELINE if number < 2 else Phase.SEARCH
            journal.commit(None, (request(number), phase))
            record = rig.run(request(number))
            journal.commit(CompletedTrial(request(number), record, 2.0, 1.0), None)
        kept = [int(trial_id[-5:]) for trial_id in journal.stored_trial_ids()]
        assert kept == [0, 1, *range(15, 20)]
        assert [entry.cost for entry in journal.entries()] == [2.0] * 20
        with pytest.raises(JournalError, match="keeps the latest 5"):
            journal.record(request(7).trial_id)


@pytest.mark.parametrize("large", [0, 2**40])
def test_large_journal_cut_short_or_torn_is_refused(large, tmp_path, monkeypatch):
    monkeypatch.setattr(sqlite, "_LARGE_bytes", large)
    interrupted(tmp_path / "run", "otis", 11)
    path = tmp_path / "run" / FILE_NAME
    whole = path.read_bytes()
    for damaged in (whole[:-4096], whole[:5000] + bytes(4096) + whole[9096:]):
        path.write_bytes(damaged)
        with pytest.raises(JournalError, match="damaged"):
            Journal.open(tmp_path / "run", write=True)


class GrowingJournal:
    """Grows by 10 kB a trial, one a second."""

    folder = Path()
    size = 0

    def size_bytes(self) -> int:
        return self.size


@pytest.mark.parametrize(
    ("free", "trials_left", "words"),
    [
        (1e9, 1_000, ""),  # it fits
        (1e9, 1_000_000, ""),  # it does not, but the disk lasts longer than a day
        (1e8, 1_000_000, "the disk will be full in 2.8 h"),
        (0.0, 1_000, "the disk will be full in 0 h"),
    ],
)
def test_run_that_outgrows_its_disk_says_so_a_day_before(free, trials_left, words, monkeypatch):
    journal = GrowingJournal()
    now = iter((0.0, float(disk_space.INTERVAL)))
    monkeypatch.setattr(disk_space.time, "monotonic", lambda: next(now))
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    forecast = disk_space.DiskForecast(journal)
    for _ in range(disk_space.INTERVAL):
        journal.size += 10_000
        warning = forecast.warning(trials_left)
    assert warning.startswith(words)
    assert bool(warning) == bool(words)
