"""Cells on the workers of a Dask cluster, and what is said when the cluster ends half way."""

import importlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from estune.errors import EstuneError, InvalidInput
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.cell_runner import run_model
from estune.studies.sweep.outcome import CellOutcome, failed

ANSWERS_WITHIN_s = 10.0
"""How long a cluster may be without a single worker, or its scheduler silent."""


def on_cluster(cells: Sequence[Cell], address: str) -> Iterator[CellOutcome]:
    """On the workers of a Dask cluster, which must have estune and what the models are named by.

    Args:
        cells: Cells of models.
        address: Of the scheduler, such as tcp://127.0.0.1:8786.

    Raises:
        InvalidInput: Dask is not installed.
        EstuneError: nothing answers there, no worker joins, or the cluster ended half way.
    """
    try:
        dask: Any = importlib.import_module("distributed")  # slow to import, and an extra
    except ImportError as error:
        raise InvalidInput(
            "a cluster needs Dask, which is not installed: pip install 'estune[cluster]'"
        ) from error
    try:
        client = dask.Client(address, timeout=ANSWERS_WITHIN_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise EstuneError(
            f"no Dask scheduler answers at {address}; start one with: dask scheduler"
        ) from error
    with _silent(logging.getLogger("distributed.client")), client:
        yield from _from_cluster(dask, client, cells)


@contextmanager
def _silent(log: logging.Logger) -> Iterator[None]:
    """Keeps Dask's tracebacks of a lost scheduler away; the loss is told in a sentence."""
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


def _from_cluster(dask: Any, client: Any, cells: Sequence[Cell]) -> Iterator[CellOutcome]:
    """What the workers give back; the cells go to them with the name of what runs them."""
    futures = client.map(run_model, cells, pure=False, key=[f"estune-{c.key}" for c in cells])
    waiting = dict(zip(futures, cells, strict=True))
    try:
        while waiting:
            # Both errors are looked at below.
            with client.as_current(), suppress(TimeoutError, dask.CancelledError):
                dask.wait(list(waiting), ANSWERS_WITHIN_s, "FIRST_COMPLETED")
            done = [future for future in waiting if future.done()]
            _check_alive(client, done)
            for future in done:
                try:
                    outcome = _of_future(future, waiting[future])
                except (OSError, dask.CancelledError):
                    # The worker that has it has died, and another does it again; or the scheduler
                    # has, which is seen next time round.
                    continue
                del waiting[future]
                yield outcome
    finally:
        client.cancel(list(waiting))


def _check_alive(client: Any, done: Sequence[Any]) -> None:
    """Sees to it that there is a cluster to wait for.

    Raises:
        EstuneError: there is none any more.
    """
    kept = "the cells done so far are kept: call the sweep again once it is back"
    if client.status != "running" or any(future.cancelled() for future in done):
        raise EstuneError(f"the cluster's scheduler has ended; {kept}")
    if not done and not client.scheduler_info(n_workers=1)["workers"]:
        raise EstuneError(
            f"the cluster has had no worker for {ANSWERS_WITHIN_s:g} s; start some with: "
            f"dask worker ADDRESS; {kept}"
        )


def _of_future(future: Any, cell: Cell) -> CellOutcome:
    error = future.exception(timeout=ANSWERS_WITHIN_s)
    if error is not None:  # a worker that dies of the cell each time, or does not know estune
        return failed(cell, f"{type(error).__name__}: {error}")
    outcome: CellOutcome = future.result(timeout=ANSWERS_WITHIN_s)
    return outcome
