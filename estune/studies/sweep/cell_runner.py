"""Runs one cell: in this process for a model, over the network for a rig at an endpoint."""

import time
from pathlib import Path

from estune import api
from estune.errors import EstuneError, UnsafeStart
from estune.run.journal import FILE_NAME
from estune.run.loop import ProgressListener, Stopped
from estune.run.result import TuneResult
from estune.studies.sweep.cell import Cell, noise_seed, opened
from estune.studies.sweep.outcome import CellOutcome, failed, finished, unsafe
from estune.trial import Rig


def run_model(cell: Cell) -> CellOutcome:
    """Tunes a model at the cell's place; whatever goes wrong is in what is returned.

    Nothing is written: what a simulated cell came to can be had again from the cell alone.
    """
    began = time.perf_counter()
    try:
        with opened(cell.rig, cell.model, noise_seed(cell)) as rig:
            return _tuned(cell, rig, began)
    except Exception as error:  # noqa: BLE001  a failing cell is a record, and the others go on
        return failed(cell, _sentence(error), time.perf_counter() - began)


def run_on_rig(cell: Cell, rig: Rig, runs: Path, watch: ProgressListener) -> CellOutcome:
    """Tunes a rig; the run is kept on disk, so that one cut off goes on where it was.

    Args:
        cell: The cell.
        rig: Its rig, connected.
        runs: Folder of the sweep's runs.
        watch: Told of each trial.

    Raises:
        Stopped: interrupted; the rig is back at its live gains.
    """
    began = time.perf_counter()
    try:
        return _tuned(cell, rig, began, runs, watch)
    except Stopped:
        raise
    except Exception as error:  # noqa: BLE001  as above
        return failed(cell, _sentence(error), time.perf_counter() - began)


def _tuned(
    cell: Cell,
    rig: Rig,
    began: float,
    runs: Path | None = None,
    watch: ProgressListener | None = None,
) -> CellOutcome:
    start = cell.start or rig.describe().gains
    try:
        result = _result(cell, rig, runs, watch)
    except UnsafeStart as error:
        return unsafe(cell, start, str(error), time.perf_counter() - began)
    return finished(cell, result, time.perf_counter() - began)


def _result(cell: Cell, rig: Rig, runs: Path | None, watch: ProgressListener | None) -> TuneResult:
    name = f"cell-{cell.key}"
    if runs is not None and (runs / name / FILE_NAME).exists():
        return api.resume(runs / name, rig, watch=watch)
    return api.tune(
        rig,
        tuner=cell.tuner,
        start=cell.start,
        step=cell.step,
        cost=cell.cost,
        run=name,
        folder=runs or api.RUNS,
        journal=runs is not None,
        watch=watch,
        **cell.search,
    )


def _sentence(error: Exception) -> str:
    """What went wrong: what estune says, or the kind and words of any other error."""
    return str(error) if isinstance(error, EstuneError) else f"{type(error).__name__}: {error}"
