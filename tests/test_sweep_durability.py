"""Finished cells of a sweep survive the death of its process and of its cluster."""

import os
import random
import subprocess
import sys
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

import estune
import plants
from estune.errors import EstuneError, JournalError
from estune.studies.sweep.cells import expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.outcome import KIND, CellOutcome
from estune.studies.sweep.store import FILE_NAME
from estune.support.sqlite import SqliteFile
from tests.support_dask import cluster
from tests.test_sweep import alike, run_sweep

DESIGN = """
lengths_m = [0.5, 0.8, 1.1, 1.4]
rigs = ["tests.test_sweep_durability:LoggedReel"]
tuners = ["least_squares_gradient"]
seeds = 4
trials = 20
repeats = 2
"""

LOG = "ESTUNE_TEST_SWEEP_LOG"


class LoggedReel:
    """The reference reel, which logs each time a rig of it is made, if `LOG` names a file."""

    def __init__(self, cable_length_m):
        self._reel = plants.reference_reel(cable_length_m)

    def rig(self, seed):
        if LOG in os.environ:
            with Path(os.environ[LOG]).open("a", encoding="utf-8") as log:
                log.write(f"{seed}\n")  # it identifies the cell
        return self._reel.rig(seed=seed)


def finish_times(folder: Path) -> dict[str, str]:
    """When each cell in a sweep's file was finished, by its key."""
    try:
        with SqliteFile.open_reader(folder / FILE_NAME, KIND) as file:
            return dict(file.rows("SELECT key, finished_at FROM cell"))
    except JournalError:  # no file yet, or killed before its table was there
        return {}


def children(pid: int) -> list[Path]:
    """Child processes of a process, as folders in /proc."""
    folders = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has just ended
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            folders += [folder] * (int(parent) == pid)
    return folders


def all_end(processes: list[Path], within_s: float = 30.0) -> bool:
    end = time.monotonic() + within_s
    while any(process.exists() for process in processes) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(process.exists() for process in processes)


def designed(folder: Path, seeds: int) -> Path:
    """The file of a sweep of four cells for each seed."""
    file = folder / "sweep.toml"
    file.write_text(DESIGN.replace("seeds = 4", f"seeds = {seeds}"))
    return file


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Outcomes of a sweep of so many seeds that nothing disturbs."""

    @cache
    def outcomes(seeds):
        folder = tmp_path_factory.mktemp("undisturbed")
        return run_sweep(folder / "whole", designed(folder, seeds)).outcomes

    return outcomes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kills", "seeds"), [(2, 6), pytest.param(20, 40, marks=pytest.mark.nightly)]
)
def test_killed_sweep_loses_and_repeats_no_finished_cell(
    tmp_path, monkeypatch, undisturbed, kills, seeds
):
    design, folder, log = designed(tmp_path, seeds), tmp_path / "killed", tmp_path / "log"
    monkeypatch.setenv(LOG, str(log))
    cells = expand_cells(read_design(design))
    by_seed = {str(cell.noise_seed): cell.key for cell in cells}
    command = [sys.executable, "-m", "estune", "sweep", str(design), "--quiet",
               "--jobs", "2", "--folder", str(folder)]  # fmt: skip
    before: dict[str, str] = {}
    dice = random.Random(0)  # noqa: S311  moments, not secrets
    for _ in range(kills):
        log.write_text("")
        process = subprocess.Popen(command, cwd=Path(__file__).parent.parent)
        goal = len(before) + dice.randint(2, 4)
        while len(finish_times(folder)) < goal and process.poll() is None:
            time.sleep(0.1)
        time.sleep(dice.uniform(0.0, 0.3))
        workers = children(process.pid)
        process.kill()
        process.wait()
        after = finish_times(folder)
        assert before.items() <= after.items()
        assert not {by_seed.get(seed) for seed in log.read_text().split()} & before.keys()
        before = after
        assert len(workers) >= 2
        assert all_end(workers)  # no worker outlives it
    assert 2 * kills <= len(before) < len(cells)
    log.write_text("")
    result = run_sweep(folder, design)
    assert before.items() <= finish_times(folder).items()
    assert finish_times(folder).keys() == {cell.key for cell in cells}
    assert not {by_seed.get(seed) for seed in log.read_text().split()} & before.keys()
    assert all(map(alike, result.outcomes, undisturbed(seeds)))


@pytest.fixture(scope="module")
def dask():
    """A cluster of two workers, which the first of its tests leaves with one, the last without."""
    with cluster(workers=2) as started:
        yield started


@pytest.mark.slow
def test_cluster_gives_equal_outcomes_though_a_worker_is_killed(tmp_path, undisturbed, dask):
    outcomes: list[CellOutcome] = []

    def kill_one(outcome: CellOutcome) -> None:
        outcomes.append(outcome)
        if len(outcomes) == 5:
            dask.workers[0].kill()
            dask.workers[0].wait()

    design = designed(tmp_path, 4)
    result = run_sweep(tmp_path / "cluster", design, dask=dask.address, watch=kill_one)
    assert len(outcomes) == len(result.outcomes) == 16
    assert all(map(alike, result.outcomes, undisturbed(4)))


@pytest.mark.slow
def test_loss_of_the_cluster_keeps_finished_cells(tmp_path, undisturbed, dask):
    design = designed(tmp_path, 4)
    outcomes: list[CellOutcome] = []

    def end_it(outcome: CellOutcome) -> None:
        outcomes.append(outcome)
        if len(outcomes) == 3:
            dask.scheduler.kill()
            dask.scheduler.wait()

    with pytest.raises(EstuneError, match="the cluster's scheduler has ended; finished cells"):
        run_sweep(tmp_path / "cluster", design, dask=dask.address, watch=end_it)
    done = {outcome.cell.key: outcome for outcome in outcomes}
    assert set(done) == set(finish_times(tmp_path / "cluster"))
    assert len(done) >= 3
    result = run_sweep(tmp_path / "cluster", design)
    assert all(map(alike, result.outcomes, undisturbed(4)))
    assert all(alike(done[o.cell.key], o) for o in undisturbed(4) if o.cell.key in done)


def test_sweep_without_a_dask_scheduler_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.studies.sweep.executors.CLUSTER_TIMEOUT_s", 0.5)
    with pytest.raises(EstuneError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        estune.sweep(
            {"lengths_m": [0.5, 1.4], "rigs": ["plants:reference_reel"]},
            folder=tmp_path,
            dask="tcp://127.0.0.1:9",
            watch=None,
        )
