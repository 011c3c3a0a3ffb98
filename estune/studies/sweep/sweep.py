"""The library call: runs the cells of a design that are still missing, and gives all of them."""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal

from estune.errors import InvalidInput
from estune.studies.sweep import dask_executor, local_executors, progress, rig_workers
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.design import SweepDesign, read_design
from estune.studies.sweep.expand import expand_cells
from estune.studies.sweep.outcome import CellOutcome
from estune.studies.sweep.progress import Watcher
from estune.studies.sweep.result import SweepResult
from estune.studies.sweep.store import RUNS, Store

SWEEPS = "sweeps"
"""Folder that sweeps are kept in, below the one estune is called from."""


def sweep(
    design: SweepDesign | str | Path | Mapping[str, Any],
    *,
    folder: str | Path | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    watch: Watcher | Literal["auto"] | None = "auto",
) -> SweepResult:
    """Tunes at every length, tension, tuner, seed and rig of a design.

    Each cell that is done is on disk at once. Called again with the same folder, only the cells
    that are missing or failed are run; a cell is the same where everything that decides it is.

    Args:
        design: The sweep's TOML file, or the same keys as a mapping; see `SweepDesign`.
        folder: Where it is kept; below `sweeps` and called as its file by default.
        jobs: Processes for models; 1 is this one alone, None is one for each core.
        dask: Address of a Dask cluster's scheduler, to run models there.
        watch: Told of each cell; "auto" shows progress, None nothing.

    Raises:
        InvalidInput: the design, or a length, tension or limit does not fit; each is a line.
        RigError: a rig cannot be reached before anything has begun.
        JournalError: a cell cannot be kept.
        EstuneError: the cluster or a process ended half way; what is done is kept.
        Stopped: interrupted (a KeyboardInterrupt); every rig is back at its live gains.

    Example:
        >>> import estune
        >>> result = estune.sweep(
        ...     {"lengths_m": [0.5, 0.8, 1.1, 1.4], "rigs": ["plants:reference_reel"]},
        ...     folder="sweeps/reference",
        ... )
        >>> result.law().schedule().gains(0.65, 15.0)
    """
    if jobs is not None and jobs < 1:
        raise InvalidInput(f"jobs is {jobs}; it must be at least 1")
    wanted = read_design(design)
    cells = expand_cells(wanted)
    with Store.open(Path(folder or default_folder(design))) as store:
        kept = store.outcomes(cells)
        missing = [cell for cell in cells if cell.key not in kept or kept[cell.key].failed]
        outcomes = _run(missing, store.folder / RUNS, jobs, dask)
        before = len(cells) - len(missing)
        with _watching(watch, len(cells), before) as saw, closing(outcomes):
            for outcome in outcomes:
                store.keep(outcome)
                saw(outcome)
        kept = store.outcomes(cells)
    return SweepResult(wanted, tuple(kept[cell.key] for cell in cells), store.folder)


def default_folder(design: SweepDesign | str | Path | Mapping[str, Any]) -> Path:
    """Where a sweep is kept that is given no folder.

    Raises:
        InvalidInput: the design is no file, whose name it could have.
    """
    if not isinstance(design, str | Path):
        raise InvalidInput("give a folder, where the sweep is kept and goes on if it is cut off")
    return Path(SWEEPS) / Path(design).stem


def _run(
    cells: Sequence[Cell], runs: Path, jobs: int | None, dask: str | None
) -> Generator[CellOutcome]:
    """What the cells come to: models first, then rigs at endpoints."""
    models = [cell for cell in cells if cell.rig.is_model]
    others = [cell for cell in cells if not cell.rig.is_model]
    if models and dask is not None:
        yield from dask_executor.on_cluster(models, dask)
    elif models and jobs == 1:
        yield from local_executors.serial(models)
    elif models:
        yield from local_executors.on_cores(models, -1 if jobs is None else jobs)
    if others:
        yield from rig_workers.on_rigs(others, runs)


@contextmanager
def _watching(
    watch: Watcher | Literal["auto"] | None, most: int, before: int
) -> Iterator[Watcher]:
    if watch == "auto":
        with progress.watching(most, before) as saw:
            yield saw
    else:
        yield watch or (lambda _: None)
