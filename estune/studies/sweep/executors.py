"""Executors of cells of models: this process, all cores, or a Dask cluster.

Each executor is an iterator over outcomes in the order of completion. The caller commits each
outcome before it takes the next, so that no finished cell is lost.
"""

import importlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estune import api
from estune.errors import EstuneError, InvalidInput, UnsafeStart
from estune.run.journal import FILE_NAME, RUNS
from estune.run.loop import ProgressListener
from estune.run.start import KnownStart
from estune.studies.sweep.cells import Cell, open_rig
from estune.studies.sweep.outcome import CellOutcome, failed, finished, unsafe
from estune.trial import Rig

if TYPE_CHECKING:
    from estune.run.results.result import TuneResult

ORPHAN_POLL_s = 0.5
"""Interval at which a worker process checks that its parent lives."""

CLUSTER_TIMEOUT_s = 10.0
"""Longest time without a single worker, or without an answer of the scheduler."""


def run_cell(
    cell: Cell,
    runs: Path | None = None,
    watch: ProgressListener | None = None,
    on_rig: Callable[[Rig | None], None] = lambda _: None,
) -> CellOutcome:
    """Tunes the rig of a cell; a failure is an outcome too, so that the other cells go on.

    Args:
        runs: Folder in which the run is journalled, to be resumed if it is cut off; None for a
            model, whose outcome the cell alone reproduces.
        watch: Called after each trial.
        on_rig: Called with the rig once it is open, and with None before it is closed.

    Raises:
        Stopped: interrupted; the rig is back at its live gains.
    """
    began = time.perf_counter()
    try:
        with open_rig(cell.rig, cell.model, cell.noise_seed) as rig:
            on_rig(rig)
            start = cell.start or rig.describe().gains
            start = start.gains if isinstance(start, KnownStart) else start
            try:
                result = _tune(cell, rig, runs, watch)
            except UnsafeStart as error:
                return unsafe(cell, start, str(error), time.perf_counter() - began)
            finally:
                on_rig(None)
            return finished(cell, result, time.perf_counter() - began)
    except EstuneError as error:
        why = str(error)
    except Exception as error:  # noqa: BLE001  a model of the user's may raise anything
        why = f"{type(error).__name__}: {error}"
    return failed(cell, why, time.perf_counter() - began)


def _tune(cell: Cell, rig: Rig, runs: Path | None, watch: ProgressListener | None) -> "TuneResult":
    name = f"cell-{cell.key}"
    if runs is not None and (runs / name / FILE_NAME).exists():
        return api.resume(runs / name, rig, watch=watch)
    return api.tune(
        rig, tuner=cell.tuner, start=cell.start, step=cell.step, cost=cell.cost, run=name,
        folder=runs or RUNS, journal=runs is not None, watch=watch, **cell.search,
    )  # fmt: skip


def on_cores(cells: Sequence[Cell], jobs: int) -> Iterator[CellOutcome]:
    """Runs cells in processes that are started afresh, never forked.

    Raises:
        EstuneError: a process was killed from outside.
    """
    from joblib import Parallel, delayed  # noqa: PLC0415  slow to import
    from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415

    # Batches of one cell, so that each is committed as soon as it is finished.
    parallel = Parallel(
        jobs, backend="loky", return_as="generator_unordered", batch_size=1, max_nbytes=None
    )
    try:
        yield from parallel(delayed(_run_as_child)(os.getpid(), cell) for cell in cells)
    except TerminatedWorkerError as error:
        raise EstuneError(
            "a worker process was killed, possibly for lack of memory; finished cells are kept: "
            "run the sweep again, with fewer --jobs"
        ) from error


def _run_as_child(parent: int, cell: Cell) -> CellOutcome:
    _end_with(parent)
    return run_cell(cell)


@cache
def _end_with(parent: int) -> None:
    """Ends this process soon after its parent, which if killed cannot end it itself."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ORPHAN_POLL_s)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def on_cluster(cells: Sequence[Cell], address: str) -> Iterator[CellOutcome]:
    """Runs cells on the workers of a Dask cluster, which must have estune and the models.

    Raises:
        InvalidInput: Dask is not installed.
        EstuneError: no scheduler answers, no worker joins, or the cluster ends half way.
    """
    try:
        dask: Any = importlib.import_module("distributed")  # slow to import, and an extra
    except ImportError as error:
        raise InvalidInput(
            "a cluster needs Dask, which is not installed: pip install 'estune[cluster]'"
        ) from error
    try:
        client = dask.Client(address, timeout=CLUSTER_TIMEOUT_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise EstuneError(
            f"no Dask scheduler answers at {address}; start one with: dask scheduler"
        ) from error
    with _silenced(logging.getLogger("distributed.client")), client:
        yield from _from_cluster(dask, client, cells)


@contextmanager
def _silenced(log: logging.Logger) -> Iterator[None]:
    """Suppresses Dask's tracebacks of a lost scheduler, which an EstuneError reports."""
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


def _from_cluster(dask: Any, client: Any, cells: Sequence[Cell]) -> Iterator[CellOutcome]:
    futures = client.map(run_cell, cells, pure=False, key=[f"estune-{c.key}" for c in cells])
    waiting = dict(zip(futures, cells, strict=True))
    try:
        while waiting:
            # `_check_alive` looks at both errors.
            with client.as_current(), suppress(TimeoutError, dask.CancelledError):
                dask.wait(list(waiting), CLUSTER_TIMEOUT_s, "FIRST_COMPLETED")
            done = [future for future in waiting if future.done()]
            _check_alive(client, done)
            for future in done:
                try:
                    outcome = _outcome(future, waiting[future])
                except (OSError, dask.CancelledError):
                    # Either its worker died, and another runs the cell again, or the scheduler
                    # did, which the next round detects.
                    continue
                del waiting[future]
                yield outcome
    finally:
        client.cancel(list(waiting))


def _check_alive(client: Any, done: Sequence[Any]) -> None:
    """Raises an EstuneError if the cluster has no scheduler or no worker."""
    advice = "finished cells are kept; run the sweep again once it is back"
    if client.status != "running" or any(future.cancelled() for future in done):
        raise EstuneError(f"the cluster's scheduler has ended; {advice}")
    if not done and not client.scheduler_info(n_workers=1)["workers"]:
        raise EstuneError(
            f"the cluster has had no worker for {CLUSTER_TIMEOUT_s:g} s; start some with: "
            f"dask worker ADDRESS; {advice}"
        )


def _outcome(future: Any, cell: Cell) -> CellOutcome:
    error = future.exception(timeout=CLUSTER_TIMEOUT_s)
    if error is not None:  # the cell kills every worker, or a worker has no estune
        return failed(cell, f"{type(error).__name__}: {error}")
    outcome: CellOutcome = future.result(timeout=CLUSTER_TIMEOUT_s)
    return outcome
