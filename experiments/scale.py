"""What do a daemon of 10 to 200 rigs, a long run and a large sweep cost, and how does that grow?

Command: `python -m experiments.scale --rigs 10 25 50 100 200 --trials --cells`.
Target: no lease lost; limits of time and memory for a fleet, a journal and a sweep.

A daemon tunes and holds fleets of rigs (`experiments.fleet`). Journals hold real runs of a tuner
on recorded trials of the reference reel, 632 samples each, with other noise in every trial. Sweeps
have as many cells (`experiments.large_sweep`). Times are process times of whole commands, with the
start of Python.
"""

import contextlib
import functools
import math
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import estune
import plants
from estune.core.gains import Gains
from estune.run.journal import FILE_NAME, Journal
from estune.run.loop import Stopped
from estune.trial import RigDescription, TrialRecord, TrialRequest
from experiments.command_costs import command_costs
from experiments.fleet import HOLD_S, SEARCH_TRIALS, measure, targets_of
from experiments.fleet import TUNER as FLEET_TUNER
from experiments.large_sweep import measure_sweep
from experiments.results import (
    Target,
    at_most,
    command_line,
    print_figures,
    print_results,
    print_tables,
)

TRIALS = (1_000, 10_000, 100_000)
QUICK_TRIALS = (200, 1_000)
RIGS = (10, 25, 50, 100, 200)
QUICK_RIGS = (25,)
QUICK_HOLD_S = 5.0
QUICK_SEARCH_TRIALS = 4
CELLS = (700, 7_000, 100_000)
QUICK_CELLS = (70,)
TUNER = "killingsworth"
EPILOG = (
    "The full form holds fleets of 10 to 200 rigs, and makes journals of up to 100 000 trials "
    "(1 GB) and sweeps of up to 100 000 cells (0.5 GB) in a temporary folder."
)
LIMITS = {"show_s": 1.5, "resume_s": 4.0, "parquet_s": 60.0, "bytes_per_trial": 10_000.0}
SWEEP_MB_MAX = 200.0
_RECORDED = 64
"""Recorded trials, each with noise of its own."""


class RecordedRig:
    """A rig that answers with recorded trials in turn, whatever the gains.

    Attributes:
        stops_at: Number of the trial that is interrupted instead; None for none.
    """

    stops_at: int | None = None

    def __init__(self) -> None:
        self._rig = plants.reference_reel().rig()
        description = self._rig.describe()
        requests = (
            TrialRequest("recorded", n, description.gains, description.step)
            for n in range(_RECORDED)
        )
        self._records = tuple(map(self._rig.run, requests))

    def describe(self) -> RigDescription:
        """The reel's description."""
        return self._rig.describe()

    def run(self, request: TrialRequest) -> TrialRecord:
        """A recorded trial under the id and with the gains of the request."""
        if request.number == self.stops_at:
            raise KeyboardInterrupt
        recorded = self._records[request.number % _RECORDED]
        return replace(recorded, trial_id=request.trial_id, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Makes gains live."""
        self._rig.apply(gains)

    def abort(self) -> RigDescription:
        """Nothing runs."""
        return self.describe()

    def close(self) -> None:
        """Nothing is open."""


@functools.cache
def recorded_rig() -> RecordedRig:
    """The rig, as a target of the command line."""
    return RecordedRig()


class JournalCosts(NamedTuple):
    """Costs of a run's journal at one length."""

    trials: int
    bytes_per_trial: float
    show_s: float
    resume_s: float
    parquet_s: float
    parquet_MB: float


def measure_journal(trials: int, folder: Path) -> JournalCosts:
    """Makes a run of so many trials, and times the commands that read it.

    The run is interrupted before its last trial of the search, so that `resume` reads what there
    is, and runs and confirms the rest.
    """
    run = folder / f"scale-{trials}"
    rig = recorded_rig()
    rig.stops_at = trials
    options: dict[str, Any] = {"tuner": TUNER, "tolerance": 0.0, "trials": trials}
    with contextlib.suppress(Stopped):
        estune.tune(rig, folder=folder, run=run.name, watch=None, **options)
    with Journal.open(run, write=True) as journal:
        journal.note(target="experiments.scale:recorded_rig")
    resume_s = command_costs("resume", run, "--quiet").cpu_s
    exported = run / "parquet"
    costs = JournalCosts(
        trials=trials,
        bytes_per_trial=(run / FILE_NAME).stat().st_size / len(estune.load(run).entries),
        show_s=command_costs("show", run).cpu_s,
        resume_s=resume_s,
        parquet_s=command_costs("export", run, "--quiet", "--out", exported).cpu_s,
        parquet_MB=sum(file.stat().st_size for file in exported.iterdir()) / 1e6,
    )
    shutil.rmtree(run)
    return costs


def growth_exponents(
    sizes: Sequence[float], rows: Sequence[Mapping[str, float]]
) -> dict[str, float]:
    """Exponent of each figure over the size, between the two largest sizes."""
    if len(rows) < 2:
        return {}
    span = math.log(sizes[-1] / sizes[-2])
    before, after = rows[-2], rows[-1]
    return {
        name: math.log(after[name] / before[name]) / span for name in after if before[name] > 0.0
    }


def print_table(name: str, rows: Sequence[Mapping[str, float]]) -> None:
    """A row for each size, which is its first figure, and the growth exponents of the last two."""
    sizes = [next(iter(row.values())) for row in rows]
    table = {f"{size:g}": row for size, row in zip(sizes, rows, strict=True)}
    print_figures({name: table | {"exponent": growth_exponents(sizes, rows)}})


def journal_table(sizes: Sequence[int], folder: Path) -> list[dict[str, float]]:
    """Costs of a journal at each length."""
    rows = [dict(measure_journal(trials, folder)._asdict()) for trials in sizes]
    print_table("journals", rows)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints, and returns the exit code."""
    parser = command_line(__doc__, quick="25 rigs, journals of 200 and 1 000 trials, 70 cells")
    parser.epilog = EPILOG
    parser.add_argument("--rigs", type=int, nargs="*", help="numbers of rigs; none for no fleet")
    parser.add_argument("--trials", type=int, nargs="*", help="lengths of journals; or none")
    parser.add_argument("--cells", type=int, nargs="*", help="numbers of cells of sweeps; or none")
    parser.add_argument("--busy", type=int, default=0, help="programs that compute beside a fleet")
    parser.add_argument("--tuner", default=FLEET_TUNER, help="tuner of a fleet")
    options = parser.parse_args(arguments)
    rigs = (QUICK_RIGS if options.quick else RIGS) if options.rigs is None else options.rigs
    trials = QUICK_TRIALS if options.quick else TRIALS
    trials = trials if options.trials is None else options.trials
    cells = QUICK_CELLS if options.quick else CELLS
    cells = cells if options.cells is None else options.cells
    hold_s = QUICK_HOLD_S if options.quick else HOLD_S
    search = QUICK_SEARCH_TRIALS if options.quick else SEARCH_TRIALS
    targets: dict[str, Target] = {}
    fleet, journal, sweep = [], [], []
    with tempfile.TemporaryDirectory() as temporary, print_tables(hidden=options.json):
        for number in rigs:
            costs = measure(number, options.tuner, hold_s, busy=options.busy, trials=search)
            fleet.append(dict(costs._asdict()))
            print_figures(fleet[-1])
            targets |= targets_of(costs)
        if len(fleet) > 1:
            print_figures({"growth exponent": growth_exponents(rigs, fleet)})
        if trials:
            print(f"load {os.getloadavg()[0]:.1f}")
            journal = journal_table(trials, Path(temporary))
            limits = LIMITS.items()
            targets |= {f"journal_{name}": at_most(journal[-1][name], m) for name, m in limits}
        if cells:
            sweep = [dict(measure_sweep(n, Path(temporary))._asdict()) for n in cells]
            print_table("sweeps", sweep)
            targets["sweep_peak_MB"] = at_most(sweep[-1]["peak_MB"], SWEEP_MB_MAX)
    figures = {"fleet": fleet, "journal": journal, "sweep": sweep}
    return print_results(figures, targets, as_json=options.json)


if __name__ == "__main__":
    # Ends the daemon and the rigs, too, when it is terminated.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    sys.exit(main())
