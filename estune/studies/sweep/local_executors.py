"""Cells of models in this process, or on all cores.

Each runner is an iterator over what cells came to, in the order in which they are done. Whoever
takes from it keeps each before the next, so that nothing that is done is lost.
"""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from functools import cache

from estune.errors import EstuneError
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.cell_runner import run_model
from estune.studies.sweep.outcome import CellOutcome

ORPHAN_s = 0.5
"""A worker process outlives its parent by no more than this."""


def serial(cells: Sequence[Cell]) -> Iterator[CellOutcome]:
    """One after the other in this process."""
    yield from map(run_model, cells)


def on_cores(cells: Sequence[Cell], jobs: int) -> Iterator[CellOutcome]:
    """In processes of their own, which are started afresh and never forked.

    Args:
        cells: Cells of models.
        jobs: How many at a time.

    Raises:
        EstuneError: a process was killed from outside.
    """
    from joblib import Parallel, delayed  # noqa: PLC0415  slow to import
    from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415

    # One cell at a time, so that each is kept as soon as it is done.
    parallel = Parallel(
        jobs, backend="loky", return_as="generator_unordered", batch_size=1, max_nbytes=None
    )
    try:
        yield from parallel(delayed(_run_for)(os.getpid(), cell) for cell in cells)
    except TerminatedWorkerError as error:
        raise EstuneError(
            "a process that ran cells was killed, by a lack of memory perhaps; the cells done so "
            "far are kept: call the sweep again, with fewer --jobs"
        ) from error


def _run_for(parent: int, cell: Cell) -> CellOutcome:
    """Runs a cell in a process that must not outlive the one that asked for it."""
    _end_with(parent)
    return run_model(cell)


@cache
def _end_with(parent: int) -> None:
    """Ends this process soon after its parent: one that was killed cannot ask for that itself."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ORPHAN_s)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
