"""Executor of cells on rigs at endpoints: one thread per rig, one trial at a time on each."""

import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

from estune.errors import EstuneError
from estune.run.loop import Progress
from estune.studies.sweep.cells import Cell
from estune.studies.sweep.executors import run_cell
from estune.studies.sweep.outcome import CellOutcome
from estune.trial import Rig


def on_rigs(cells: Sequence[Cell], folder: Path) -> Iterator[CellOutcome]:
    """Runs the cells of each rig in turn, and several rigs in parallel.

    Raises:
        Stopped: interrupted; every rig is back at its live gains.
    """
    by_rig: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        by_rig[cell.rig.label].append(cell)
    workers = [_RigWorker(some, folder) for some in by_rig.values()]
    done: SimpleQueue[CellOutcome | BaseException | None] = SimpleQueue()
    threads = [threading.Thread(target=worker.run, args=(done,)) for worker in workers]
    for thread in threads:
        thread.start()
    try:
        running = len(threads)
        while running:
            outcome = done.get()
            if outcome is None:
                running -= 1
            elif isinstance(outcome, CellOutcome):
                yield outcome
            else:
                raise outcome
    finally:
        # Also when interrupted: no rig is left with a trial under way.
        for worker in workers:
            worker.stop()
        for thread in threads:
            thread.join()


class _RigWorker:
    """One rig and its cells, in a thread of its own."""

    def __init__(self, cells: Sequence[Cell], folder: Path) -> None:
        self._cells = cells
        self._folder = folder
        self._stopping = threading.Event()
        self._rig: Rig | None = None

    def run(self, done: SimpleQueue[CellOutcome | BaseException | None]) -> None:
        """Runs the cells in turn; ends with None."""
        try:
            for cell in self._cells:
                if self._stopping.is_set():
                    break
                done.put(run_cell(cell, self._folder, self._on_trial, self._set_rig))
        except BaseException as error:  # noqa: BLE001  the waiting thread raises it
            done.put(error)
        finally:
            done.put(None)

    def stop(self) -> None:
        """Ends the trial under way, if any; any thread may call it, repeatedly."""
        self._stopping.set()
        rig = self._rig
        if rig is not None:
            with suppress(EstuneError):  # the worker's own thread reports it
                rig.abort()

    def _set_rig(self, rig: Rig | None) -> None:
        self._rig = rig

    def _on_trial(self, progress: Progress) -> None:  # noqa: ARG002  signature of a listener
        if self._stopping.is_set():
            raise KeyboardInterrupt  # `estune.run.loop.run` treats it as a stop
