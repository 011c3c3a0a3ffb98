"""How do 80 000 trials scale from one core to two, and what does a process or Dask add?

80 000 search trials of 400 tunings by the cost alone, at 10 lengths, 4 tensions and 10 seeds, run
once on two cores and once on one. Every tuning uses all of its 200 trials. The time is from the
call to the last cell on disk. The overhead of an executor is its time, times its processes, less
the time of the cells, per cell; for processes and for a Dask scheduler with workers on loopback,
both warm. The memory of a worker is its peak, as reported by the system.
"""

import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from distributed.deploy.subprocess import SubprocessCluster
from joblib import Parallel, delayed

import estune
from estune.studies.sweep import executors
from estune.studies.sweep.cells import Cell, expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.outcome import CellOutcome, read_traces
from experiments.results import Target, at_least, at_most, command_line, print_results

CORES = 2
TUNER = "safe_bayesian"
SECONDS_MAX, SPEEDUP_MIN, MEMORY_MAX_MB = 30.0, 1.8, 400.0
_MB = 1024.0  # ru_maxrss is in kB


class SweepExtent(NamedTuple):
    """Size of the measurement."""

    lengths: int
    tensions: int
    seeds: int  # tunings at each length and tension
    trials: int  # search trials of each
    overhead_cells: int  # cells that measure the cost of starting one

    def design(self) -> dict[str, Any]:
        """The design of the sweep; every search uses all its trials."""
        return {
            "lengths_m": np.linspace(0.5, 1.4, self.lengths).round(3).tolist(),
            "tensions_N": np.linspace(10.0, 25.0, self.tensions).tolist(),
            "seeds": self.seeds,
            "rigs": ["plants:reference_reel"],
            "tuners": [TUNER],
            "trials": self.trials,
            "tolerance": 0.0,
        }


WHOLE = SweepExtent(lengths=10, tensions=4, seeds=10, trials=200, overhead_cells=80)
QUICK = SweepExtent(lengths=2, tensions=1, seeds=2, trials=60, overhead_cells=8)


class TimedSweep(NamedTuple):
    """A whole sweep, from the call to the last cell on disk."""

    wall_s: float
    process_s: float  # time computed by this process
    outcomes: tuple[CellOutcome, ...]


def time_sweep(design: dict[str, Any], jobs: int) -> TimedSweep:
    """Runs the sweep in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        began, computed = time.perf_counter(), time.process_time()
        result = estune.sweep(design, folder=folder, jobs=jobs, watch=None)
        wall_s, process_s = time.perf_counter() - began, time.process_time() - computed
        # The traces lie in the folder, which goes.
        traces = read_traces(result.outcomes)
        loaded = (replace(o, trace_source=t) for o, t in zip(result.outcomes, traces, strict=True))
        return TimedSweep(wall_s, process_s, tuple(loaded))


def overhead_s(
    run: Callable[[Sequence[Cell]], Iterator[CellOutcome]], cells: Sequence[Cell]
) -> float:
    """Overhead of an executor for each cell, s: its processes' time less that of the cells."""
    list(run(cells))  # warms up its processes
    began = time.perf_counter()
    outcomes = list(run(cells))
    wall_s = time.perf_counter() - began
    return (CORES * wall_s - sum(outcome.duration_s for outcome in outcomes)) / len(cells)


def worker_memory_MB() -> float:
    """Peak memory of a worker process."""
    peak = delayed(_peak_memory_MB)
    return float(max(Parallel(CORES, backend="loky")(peak(0.2) for _ in range(4 * CORES))))


def _peak_memory_MB(pause_s: float) -> float:
    time.sleep(pause_s)  # so that every process gets one
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MB


def measure(extent: SweepExtent) -> dict[str, float]:
    """All figures by name."""
    design = extent.design()
    load_before = os.getloadavg()[0]
    both = time_sweep(design, CORES)
    memory = worker_memory_MB()
    one = time_sweep(design, 1)
    seconds, outcomes = both.wall_s, both.outcomes
    search = sum(int(outcome.trace[:, 0].sum()) for outcome in outcomes)
    trials = sum(len(outcome.trace) for outcome in outcomes)
    cells = expand_cells(read_design(design))[: extent.overhead_cells]
    with SubprocessCluster(
        n_workers=CORES,
        threads_per_worker=1,
        worker_class="distributed.Worker",
        dashboard_address=None,  # type: ignore[arg-type]  # no server, as its page says
    ) as dask:
        dask_s = overhead_s(lambda some: executors.on_cluster(some, dask.scheduler_address), cells)
    process_s = overhead_s(lambda some: executors.on_cores(some, CORES), cells)
    return {
        "load_before": load_before,
        "cells": float(len(outcomes)),
        "search_trials": float(search),
        "trials": float(trials),
        "two_cores_s": seconds,
        "one_core_s": one.wall_s,
        "one_core_computed_s": one.process_s,
        "speedup": one.wall_s / seconds,
        "differing_cells": float(sum(map(_differ, outcomes, one.outcomes))),
        "cell_s": statistics.fmean(outcome.duration_s for outcome in one.outcomes),
        "worker_MB": memory,
        "process_per_cell_ms": 1e3 * process_s,
        "dask_per_cell_ms": 1e3 * dask_s,
        "load_after": os.getloadavg()[0],
    }


def _differ(one: CellOutcome, other: CellOutcome) -> bool:
    return not np.array_equal(one.trace, other.trace)


def targets(figures: dict[str, float], *, whole: bool) -> dict[str, Target]:
    """The targets; the time only for the number of trials it is set for."""
    limits = {
        "speedup": at_least(figures["speedup"], SPEEDUP_MIN),
        "worker_MB": at_most(figures["worker_MB"], MEMORY_MAX_MB),
        "differing_cells": at_most(figures["differing_cells"], 0.0),
    }
    if whole:
        limits["two_cores_s"] = at_most(figures["two_cores_s"], SECONDS_MAX)
    return limits


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    options = command_line(__doc__, quick="fewer and shorter tunings").parse_args()
    figures = measure(QUICK if options.quick else WHOLE)
    limits = targets(figures, whole=not options.quick)
    return print_results(figures, limits, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
