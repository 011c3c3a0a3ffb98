"""Cells on rigs at endpoints: one trial at a time on each, several rigs side by side."""

import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

from estune.errors import EstuneError
from estune.run.loop import Progress
from estune.studies.sweep.cell import Cell, opened
from estune.studies.sweep.cell_runner import run_on_rig
from estune.studies.sweep.outcome import CellOutcome, failed
from estune.trial import Rig


def on_rigs(cells: Sequence[Cell], folder: Path) -> Iterator[CellOutcome]:
    """A thread for each rig, which runs its cells in turn.

    Args:
        cells: Cells of rigs at endpoints.
        folder: Where their runs are kept.

    Raises:
        Stopped: interrupted; every rig is back at its live gains.
    """
    by_rig: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        by_rig[cell.rig.label].append(cell)
    benches = [_RigWorker(some, folder) for some in by_rig.values()]
    done: SimpleQueue[CellOutcome | BaseException | None] = SimpleQueue()
    threads = [threading.Thread(target=bench.run, args=(done,)) for bench in benches]
    for thread in threads:
        thread.start()
    try:
        going = len(threads)
        while going:
            outcome = done.get()
            if outcome is None:
                going -= 1
            elif isinstance(outcome, CellOutcome):
                yield outcome
            else:
                raise outcome
    finally:
        # Also when interrupted: no rig is left with a trial under way.
        for bench in benches:
            bench.stop()
        for thread in threads:
            thread.join()


class _RigWorker:
    """One rig and the cells to be tuned on it, in a thread of its own."""

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

    def _one(self, cell: Cell) -> CellOutcome:
        try:
            with opened(cell.rig, cell.model) as rig:
                self._rig = rig
                try:
                    return run_on_rig(cell, rig, self._folder, self._saw)
                finally:
                    self._rig = None
        except EstuneError as error:
            return failed(cell, str(error))

    def _saw(self, progress: Progress) -> None:  # noqa: ARG002  what a watcher is told
        if self._stopping.is_set():
            raise KeyboardInterrupt  # what `estune.run.loop.run` takes for a stop
