"""`python -m experiments.sweep_speed`: the tables, or with --json the figures."""

import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed

import estune
import plants
from estune.run.plan import DEFAULT_TUNER
from estune.studies.sweep import local_executors
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.dask_executor import on_cluster
from estune.studies.sweep.design import read_design
from estune.studies.sweep.expand import expand_cells
from estune.studies.sweep.outcome import CellOutcome
from estune.trial import Rig, TrialRequest
from experiments.judged import Target, at_least, at_most, command_line, tell
from experiments.sweep_speed import __doc__ as about
from experiments.sweep_speed.cluster import cluster
from experiments.sweep_speed.peer import PeerRig

CORES = 2
LEAN_TUNER = "least_squares_gradient"
SECONDS_MAX, SPEEDUP_MIN, FASTER_MIN, MEMORY_MAX_MB = 30.0, 1.8, 100.0, 400.0
_MB = 1024.0  # ru_maxrss is in kB


class Extent(NamedTuple):
    """How much is run.

    Attributes:
        lengths: Cable lengths.
        tensions: Tensions.
        seeds: Tunings at each.
        trials: Search trials of each.
        peer_trials: Search trials of python-control.
        beside: Cells for what starting one costs.
    """

    lengths: int
    tensions: int
    seeds: int
    trials: int
    peer_trials: int
    beside: int

    def design(self) -> dict[str, Any]:
        """As a sweep's design; every search uses all its trials."""
        return {
            "lengths_m": np.linspace(0.5, 1.4, self.lengths).round(3).tolist(),
            "tensions_N": np.linspace(10.0, 25.0, self.tensions).tolist(),
            "seeds": self.seeds,
            "rigs": ["plants:reference_reel"],
            "trials": self.trials,
            "tolerance": 0.0,
        }


WHOLE = Extent(lengths=10, tensions=4, seeds=10, trials=200, peer_trials=60, beside=80)
QUICK = Extent(lengths=2, tensions=1, seeds=2, trials=60, peer_trials=8, beside=8)


class Swept(NamedTuple):
    """A whole sweep.

    Attributes:
        passed_s: From the call to the last cell on disk, s.
        computed_s: What this process itself computed meanwhile, s.
        outcomes: What the cells came to.
    """

    passed_s: float
    computed_s: float
    outcomes: tuple[CellOutcome, ...]


def whole_sweep(design: dict[str, Any], jobs: int) -> Swept:
    """Runs the sweep into a folder that is thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        began, computed = time.perf_counter(), time.process_time()
        result = estune.sweep(design, folder=folder, jobs=jobs, watch=None)
        return Swept(time.perf_counter() - began, time.process_time() - computed, result.outcomes)


def starting_s(
    run: Callable[[Sequence[Cell]], Iterator[CellOutcome]], cells: Sequence[Cell]
) -> float:
    """What a runner adds to each cell, s: its time on all its processes less the cells' own."""
    list(run(cells))  # until its processes have loaded what they need
    began = time.perf_counter()
    outcomes = list(run(cells))
    passed = time.perf_counter() - began
    return (CORES * passed - sum(outcome.duration_s for outcome in outcomes)) / len(cells)


def worker_memory_MB() -> float:
    """The most any of the worker processes of this process's runs ever held."""
    ask = delayed(_most_held_MB)
    return float(max(Parallel(CORES, backend="loky")(ask(0.2) for _ in range(4 * CORES))))


def _most_held_MB(pause_s: float) -> float:
    time.sleep(pause_s)  # so that every process gets its turn
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MB


def peer(trials: int) -> dict[str, float]:
    """One search on python-control and the same here: seconds computed a trial, and the records.

    Beside the usual tuner, the leanest, to tell what of the time is the tuner's own.
    """
    reel = plants.reference_reel(0.8, 15.0)
    about_it = reel.describe("reel", None)
    request = TrialRequest("compared", 0, about_it.gains, about_it.step)
    ours, theirs = reel.rig(seed=1).run(request), PeerRig(reel, 1).run(request)
    _computed_s(reel.rig(seed=0), 2, DEFAULT_TUNER)  # compiles the trial
    return {
        "difference_N": float(np.abs(ours.tension_N - theirs.tension_N).max()),
        "python_control_s_per_trial": _computed_s(PeerRig(reel, 1), trials, DEFAULT_TUNER),
        "s_per_trial": _computed_s(reel.rig(seed=1), trials, DEFAULT_TUNER),
        "lean_tuner_s_per_trial": _computed_s(reel.rig(seed=1), trials, LEAN_TUNER),
    }


def _computed_s(rig: Rig, trials: int, tuner: str) -> float:
    """Seconds this process computes for a trial of a search, whoever else has the core."""
    began = time.process_time()
    result = estune.tune(rig, tuner=tuner, trials=trials, tolerance=0.0, journal=False, watch=None)
    return (time.process_time() - began) / len(result.entries)


def measure(extent: Extent) -> dict[str, float]:
    """All figures by name."""
    design = extent.design()
    figures = {"load_before": os.getloadavg()[0], **peer(extent.peer_trials)}
    both = whole_sweep(design, CORES)
    memory = worker_memory_MB()
    one = whole_sweep(design, 1)
    seconds, outcomes = both.passed_s, both.outcomes
    search = sum(int(outcome.trace[:, 0].sum()) for outcome in outcomes)
    trials = sum(len(outcome.trace) for outcome in outcomes)
    cells = expand_cells(read_design(design))[: extent.beside]
    with cluster(workers=CORES) as dask:
        on_dask = starting_s(lambda some: on_cluster(some, dask.address), cells)
    return figures | {
        "cells": float(len(outcomes)),
        "search_trials": float(search),
        "trials": float(trials),
        "two_cores_s": seconds,
        "one_core_s": one.passed_s,
        "one_core_computed_s": one.computed_s,
        "speedup": one.passed_s / seconds,
        "differing_cells": float(sum(map(_differ, outcomes, one.outcomes))),
        "cell_s": statistics.fmean(outcome.duration_s for outcome in one.outcomes),
        "faster_than_python_control": figures["python_control_s_per_trial"] * trials / seconds,
        "faster_core_for_core": figures["python_control_s_per_trial"] / figures["s_per_trial"],
        "worker_MB": memory,
        "process_per_cell_ms": 1e3
        * starting_s(lambda c: local_executors.on_cores(c, CORES), cells),
        "dask_per_cell_ms": 1e3 * on_dask,
        "load_after": os.getloadavg()[0],
    }


def _differ(one: CellOutcome, other: CellOutcome) -> bool:
    return not np.array_equal(one.trace, other.trace)


def targets(figures: dict[str, float], *, whole: bool) -> dict[str, Target]:
    """What is to be reached; the time only by as many trials as it is set for."""
    found = {
        "speedup": at_least(figures["speedup"], SPEEDUP_MIN),
        "faster_than_python_control": at_least(figures["faster_than_python_control"], FASTER_MIN),
        "worker_MB": at_most(figures["worker_MB"], MEMORY_MAX_MB),
        "differing_cells": at_most(figures["differing_cells"], 0.0),
    }
    if whole:
        found["two_cores_s"] = at_most(figures["two_cores_s"], SECONDS_MAX)
    return found


WORDS = {
    "cells": "tunings",
    "search_trials": "search trials",
    "trials": "trials in all, with those of start and confirmation",
    "two_cores_s": f"seconds on {CORES} cores",
    "one_core_s": "seconds on one",
    "one_core_computed_s": "  of which it computed; the rest others had the core",
    "speedup": "times faster",
    "differing_cells": "tunings that differ between the two",
    "cell_s": "seconds a tuning, on one core",
    "python_control_s_per_trial": "seconds computed a trial of the same loop on python-control",
    "s_per_trial": "seconds computed a trial of the same search here",
    "lean_tuner_s_per_trial": f"  and with {LEAN_TUNER}: the rest is the usual tuner's own",
    "difference_N": "largest difference between their records, N",
    "faster_than_python_control": f"times faster than that loop, {CORES} cores to its one",
    "faster_core_for_core": "times faster, core for core",
    "worker_MB": "most memory a worker held, MB",
    "process_per_cell_ms": "what a process adds to a tuning, ms",
    "dask_per_cell_ms": "what Dask adds to a tuning, ms",
    "load_before": "load of the machine before",
    "load_after": "load of the machine after",
}


def main() -> int:
    """Measures, prints, and says by its exit code whether every target was met."""
    options = command_line(about, quick="fewer and shorter tunings").parse_args()
    figures = measure(QUICK if options.quick else WHOLE)
    if not options.json:
        for name, words in WORDS.items():
            print(f"{figures[name]:12.5g}  {words}")
    reached = targets(figures, whole=not options.quick)
    return tell(figures, reached, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
