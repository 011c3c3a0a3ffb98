"""A sweep of many cells: memory and time to read its outcomes, and to fit and draw their law.

Real outcomes of a few cells are stored for all cells, their gains moved at random. Then the
command that made them is called again: it reads all cells, fits the law, and writes page and
table.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import EstuneError
from estune.studies.sweep.cells import Cell, expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.executors import run_cell
from estune.studies.sweep.outcome import CellOutcome
from estune.studies.sweep.store import SweepStore
from experiments.scale.command_costs import command_costs

LENGTHS_m = (0.5, 0.65, 0.8, 0.95, 1.1, 1.25, 1.4)
SPREAD = 0.02
"""Standard deviation of the logarithm of a gain between tunings at one length."""

_STORED_AT_ONCE = 1000

_DESIGN = """
lengths_m = {lengths}
rigs = ["plants:reference_reel"]
trials = 30
tuners = ["least_squares_gradient"]
seeds = {seeds}
"""


class SweepCosts(NamedTuple):
    """Costs of a sweep at one size.

    CPU time of one cell of 30 trials; of the finished sweep, the command's CPU time and peak
    memory.
    """

    cells: int
    cell_s: float
    bytes_per_cell: float
    command_s: float
    peak_MB: float


def measure_sweep(cells: int, folder: Path) -> SweepCosts:
    """Stores a sweep of about so many cells, and measures the command that reads it."""
    file = folder / f"sweep-{cells}.toml"
    seeds = max(cells // len(LENGTHS_m), 1)
    file.write_text(_DESIGN.format(lengths=list(LENGTHS_m), seeds=seeds), "utf-8")
    stored, cell_s = _store(file, folder / file.stem)
    command = ("sweep", file, "--quiet", "--folder", folder / file.stem)
    used = command_costs(*command)
    size = (folder / file.stem / "sweep.sqlite").stat().st_size
    return SweepCosts(
        cells=stored,
        cell_s=cell_s,
        bytes_per_cell=size / stored,
        command_s=used.cpu_s,
        peak_MB=used.peak_MB,
    )


def _store(file: Path, folder: Path) -> tuple[int, float]:
    """Stores an outcome of each cell; the number of cells, and the CPU time of a real one, s."""
    cells, rng = expand_cells(read_design(file)), np.random.default_rng(0)
    run_cell(cells[0])  # compiles the trial
    began_s = time.process_time()
    real = {cell.length_m: run_cell(cell) for cell in cells if cell.seed == 0}
    cell_s = (time.process_time() - began_s) / len(real)
    folder.mkdir()
    with SweepStore.open(folder) as store:
        for first in range(0, len(cells), _STORED_AT_ONCE):
            some = cells[first : first + _STORED_AT_ONCE]
            moved = np.exp(SPREAD * rng.standard_normal((len(some), 4)))
            store.add(*(_moved(real[c.length_m], c, f) for c, f in zip(some, moved, strict=True)))
    return len(cells), cell_s


def _moved(outcome: CellOutcome, cell: Cell, factors: FloatArray) -> CellOutcome:
    """An outcome as that of another cell, converged, its gains multiplied by factors."""
    if outcome.gains is None:
        raise EstuneError(f"{outcome.cell.label}: {outcome.message}")
    gains = Gains(*map(float, factors * outcome.gains.as_tuple()))
    return replace(outcome, cell=cell, gains=gains, remaining=0.01)
