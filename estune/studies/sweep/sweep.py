"""The library call `estune.sweep`: runs the missing cells of a design, returns all of them."""

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal, TextIO

from estune.errors import InvalidInput
from estune.run.progress import ProgressStatus, show_progress
from estune.studies.sweep import executors, rig_workers
from estune.studies.sweep.cells import Cell, expand_cells
from estune.studies.sweep.design import SweepDesign, read_design
from estune.studies.sweep.outcome import CellOutcome
from estune.studies.sweep.result import SweepResult
from estune.studies.sweep.store import RUNS, SweepStore

SWEEPS = "sweeps"
"""Default folder of sweeps, in the current directory."""

Watcher = Callable[[CellOutcome], None]
"""Called with each outcome after it was committed; must return quickly."""


def sweep(
    design: SweepDesign | str | Path | Mapping[str, Any],
    *,
    folder: str | Path | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    watch: Watcher | Literal["auto"] | None = "auto",
) -> SweepResult:
    """Tunes at every length, tension, tuner, seed and rig of a design.

    Each finished cell is committed to disk at once. A further call with the same folder runs only
    the cells that are missing or failed; cells are identified by everything that determines them.

    Args:
        design: The sweep's TOML file, or the same keys as a mapping; see `SweepDesign`.
        folder: Folder of the sweep; by default `sweeps/NAME`, after the file.
        jobs: Number of processes for models; 1 uses this one, None one for each core.
        dask: Address of the scheduler of a Dask cluster that runs the models.
        watch: Called with each outcome; "auto" shows progress, None nothing.

    Raises:
        InvalidInput: the design, a length, a tension or a limit does not fit; one line for each.
        RigError: a rig cannot be reached before the sweep begins.
        JournalError: an outcome cannot be stored.
        EstuneError: the cluster or a process ended half way; finished cells are stored.
        Stopped: interrupted (a KeyboardInterrupt); every rig is back at its live gains.

    Example:
        >>> import estune
        >>> result = estune.sweep(
        ...     {"lengths_m": [0.5, 0.8, 1.1, 1.4], "rigs": ["plants:reference_reel"]},
        ...     folder="sweeps/reference",
        ... )
        >>> gains = result.law().schedule().gains(0.65, 15.0)
    """
    if jobs is not None and jobs < 1:
        raise InvalidInput(f"jobs is {jobs}; it must be at least 1")
    checked = read_design(design)
    cells = expand_cells(checked)
    with SweepStore.open(Path(folder or _default_folder(design))) as store:
        missing = store.missing(cells)
        outcomes = _run(missing, store.folder / RUNS, jobs, dask)
        with _watching(watch, len(cells), len(missing)) as watcher, closing(outcomes):
            for outcome in outcomes:
                store.add(outcome)
                watcher(outcome)
        stored = store.outcomes(cells)
    result = SweepResult(checked, stored, store.folder)
    result.write_cells()
    return result


def _default_folder(design: SweepDesign | str | Path | Mapping[str, Any]) -> Path:
    if not isinstance(design, str | Path):
        raise InvalidInput("no folder is given; give one, which stores the sweep to continue it")
    return Path(SWEEPS) / Path(design).stem


def _run(
    cells: Sequence[Cell], runs: Path, jobs: int | None, dask: str | None
) -> Generator[CellOutcome]:
    """The outcomes of the cells: models first, then rigs at endpoints."""
    models = [cell for cell in cells if cell.rig.is_model]
    remote = [cell for cell in cells if not cell.rig.is_model]
    if models and dask is not None:
        yield from executors.on_cluster(models, dask)
    elif models and jobs == 1:
        yield from map(executors.run_cell, models)
    elif models:
        yield from executors.on_cores(models, -1 if jobs is None else jobs)
    if remote:
        yield from rig_workers.on_rigs(remote, runs)


@contextmanager
def _watching(
    watch: Watcher | Literal["auto"] | None, cells: int, missing: int
) -> Iterator[Watcher]:
    if watch == "auto":
        with show_outcomes(cells, missing) as watcher:
            yield watcher
    else:
        yield watch or (lambda _: None)


@contextmanager
def show_outcomes(cells: int, missing: int, stream: TextIO | None = None) -> Iterator[Watcher]:
    """A watcher that shows the progress of a sweep for the duration of the block."""
    done = failed = 0
    last = ""
    began = time.monotonic()

    def status() -> ProgressStatus:
        pace = (time.monotonic() - began) / done if done else math.nan
        return ProgressStatus(
            stage="",
            done=cells - missing + done,
            total=cells,
            unit="cells",
            alerts=f"{failed} failed" if failed else "",
            summary=last,
            details=(("last", last),),
            remaining_s=pace * (missing - done),
        )

    with show_progress(status, stream=stream) as update:

        def watch(outcome: CellOutcome) -> None:
            nonlocal done, failed, last
            done, failed, last = done + 1, failed + outcome.failed, _line(outcome)
            update()

        yield watch


def _line(outcome: CellOutcome) -> str:
    cost = f", cost {outcome.cost:.3g}" if math.isfinite(outcome.cost) else ""
    return f"{outcome.cell.label}: {outcome.ending}{cost}"
