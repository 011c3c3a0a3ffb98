"""Many cells at once: in this process, on all cores, on a Dask cluster, on rigs side by side.

Each is an iterator over what cells came to, in the order in which they are done. Whoever takes
from it keeps each before the next, so that nothing that is done is lost.
"""

import importlib
import logging
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from estune.errors import EstuneError, InvalidInput
from estune.sweeping.cells import Cell, opened
from estune.sweeping.outcome import Outcome, failed
from estune.sweeping.running import run_model, run_on_rig
from estune.trial import Rig
from estune.tuning import Progress

CLUSTER_ANSWERS_WITHIN_s = 10.0
"""How long a cluster may be without a single worker, or its scheduler silent."""


def serial(cells: Sequence[Cell]) -> Iterator[Outcome]:
    """One after the other in this process."""
    yield from map(run_model, cells)


def on_cores(cells: Sequence[Cell], jobs: int) -> Iterator[Outcome]:
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
        yield from parallel(delayed(run_model)(cell) for cell in cells)
    except TerminatedWorkerError as error:
        raise EstuneError(
            "a process that ran cells was killed, by a lack of memory perhaps; the cells done so "
            "far are kept: call the sweep again, with fewer --jobs"
        ) from error


def on_cluster(cells: Sequence[Cell], address: str) -> Iterator[Outcome]:
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
        client = dask.Client(address, timeout=CLUSTER_ANSWERS_WITHIN_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise EstuneError(
            f"no Dask scheduler answers at {address}; start one with: dask scheduler"
        ) from error
    with client, _silent(logging.getLogger("distributed.client")):
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


def _from_cluster(dask: Any, client: Any, cells: Sequence[Cell]) -> Iterator[Outcome]:
    """What the workers give back; the cells go to them with the name of what runs them."""
    futures = client.map(run_model, cells, pure=False, key=[f"estune-{c.key}" for c in cells])
    waiting = dict(zip(futures, cells, strict=True))
    try:
        while waiting:
            # Both errors are looked at below.
            with client.as_current(), suppress(TimeoutError, dask.CancelledError):
                dask.wait(list(waiting), CLUSTER_ANSWERS_WITHIN_s, "FIRST_COMPLETED")
            done = [future for future in waiting if future.done()]
            _check_alive(client, done)
            for future in done:
                try:
                    outcome = _of_future(future, waiting[future])
                except TimeoutError:  # the worker that did it has died; another does it again
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
            f"the cluster has had no worker for {CLUSTER_ANSWERS_WITHIN_s:g} s; start some with: "
            f"dask worker ADDRESS; {kept}"
        )


def _of_future(future: Any, cell: Cell) -> Outcome:
    error = future.exception(timeout=CLUSTER_ANSWERS_WITHIN_s)
    if error is not None:  # a worker that dies of the cell each time, or does not know estune
        return failed(cell, f"{type(error).__name__}: {error}")
    outcome: Outcome = future.result(timeout=CLUSTER_ANSWERS_WITHIN_s)
    return outcome


def on_rigs(cells: Sequence[Cell], folder: Path) -> Iterator[Outcome]:
    """On rigs at endpoints: one trial at a time on each, several rigs side by side.

    Args:
        cells: Cells of rigs at endpoints.
        folder: Where their runs are kept.

    Raises:
        Stopped: interrupted; every rig is back at its live gains.
    """
    by_rig: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        by_rig[cell.rig.label].append(cell)
    benches = [_Bench(some, folder) for some in by_rig.values()]
    done: SimpleQueue[Outcome | BaseException | None] = SimpleQueue()
    threads = [threading.Thread(target=bench.run, args=(done,)) for bench in benches]
    for thread in threads:
        thread.start()
    try:
        going = len(threads)
        while going:
            outcome = done.get()
            if outcome is None:
                going -= 1
            elif isinstance(outcome, Outcome):
                yield outcome
            else:
                raise outcome
    finally:
        # Also when interrupted: no rig is left with a trial under way.
        for bench in benches:
            bench.stop()
        for thread in threads:
            thread.join()


class _Bench:
    """One rig and the cells to be tuned on it, in a thread of its own."""

    def __init__(self, cells: Sequence[Cell], folder: Path) -> None:
        self._cells = cells
        self._folder = folder
        self._stopping = threading.Event()
        self._rig: Rig | None = None

    def run(self, done: SimpleQueue[Outcome | BaseException | None]) -> None:
        """Runs the cells in turn; ends with None."""
        try:
            for cell in self._cells:
                if self._stopping.is_set():
                    break
                done.put(self._one(cell))
        except BaseException as error:  # noqa: BLE001  it is raised in the thread that waits
            done.put(error)
        finally:
            done.put(None)

    def stop(self) -> None:
        """Ends the trial under way, if any; may be called again and by any thread."""
        self._stopping.set()
        rig = self._rig
        if rig is not None:
            with suppress(EstuneError):  # its own thread tells what became of it
                rig.abort()

    def _one(self, cell: Cell) -> Outcome:
        try:
            with opened(cell.rig, cell.length_m, cell.tension_N) as rig:
                self._rig = rig
                try:
                    return run_on_rig(cell, rig, self._folder, self._saw)
                finally:
                    self._rig = None
        except EstuneError as error:
            return failed(cell, str(error))

    def _saw(self, progress: Progress) -> None:  # noqa: ARG002  what a watcher is told
        if self._stopping.is_set():
            raise KeyboardInterrupt  # what `estune.tuning.run` takes for a stop
