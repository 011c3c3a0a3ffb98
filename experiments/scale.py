"""What do 200 rigs, a long run, a large sweep and many records cost, and how does that grow?

Command: `python -m experiments.scale --rigs 10 25 50 100 200 --trials --cells --records`.
Target: no lease lost; limits of time and memory for a fleet, a journal, a sweep and a diagnosis,
which is right.

A daemon tunes and holds fleets of rigs (`experiments.fleet`). Journals hold real runs of a tuner
on recorded trials of the reference reel, 632 samples each, with other noise in every trial. Sweeps
have as many cells (`experiments.large_sweep`), diagnoses as many records of 10 000 samples
(`experiments.many_records`). Times are process times, of whole commands with the start of Python.
"""

import contextlib
import functools
import math
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
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
from experiments.fleet import HOLD_S, SEARCH_TRIALS, measure
from experiments.fleet import LIMITS as FLEET_LIMITS
from experiments.fleet import TUNER as FLEET_TUNER
from experiments.large_sweep import measure_sweep
from experiments.many_records import measure_diagnosis
from experiments.results import Target, at_least, at_most, command_line, print_results

SIZES = {
    "rigs": ((10, 25, 50, 100, 200), (25,)),
    "trials": ((1_000, 10_000, 100_000), (200, 1_000)),
    "cells": ((700, 7_000, 100_000), (70,)),
    "records": ((10, 20, 40, 80), (2, 4)),
}
"""Sizes of fleets, journals, sweeps and diagnoses, in the full and in the short form."""

QUICK_HOLD_S = 5.0
QUICK_SEARCH_TRIALS = 4
TUNER = "killingsworth"
EPILOG = (
    "The full form holds fleets of 10 to 200 rigs, and makes journals of up to 100 000 trials "
    "(1 GB) and sweeps of up to 100 000 cells (0.5 GB) in a temporary folder."
)
LIMITS = {"show_s": 1.5, "resume_s": 4.0, "parquet_s": 60.0, "bytes_per_trial": 10_000.0}
SWEEP_MB_MAX = 200.0
DIAGNOSIS_LIMITS = {"cpu_s": 60.0, "memory_MB": 1000.0}
"""Limits for the most records."""

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


Rows = list[dict[str, float]]


def growth_exponents(rows: Rows) -> dict[str, float]:
    """Exponent of each figure over the size, the first one, between the two largest sizes."""
    if len(rows) < 2:
        return {}
    before, after = rows[-2], rows[-1]
    grown = {name: math.log(after[name] / before[name]) for name in after if before[name] > 0.0}
    span = next(iter(grown.values()))
    return {name: value / span for name, value in grown.items()}


def targets_of(rows: dict[str, Rows]) -> dict[str, Target]:
    """The targets; those of growing costs at the largest size."""
    targets = {
        f"fleet_{name}": at_most(max(row[name] for row in rows["rigs"]), most)
        for name, most in FLEET_LIMITS.items()
        if rows["rigs"]
    }
    for what, size, limits in (
        ("journal", "trials", LIMITS),
        ("sweep", "cells", {"peak_MB": SWEEP_MB_MAX}),
        ("diagnosis", "records", DIAGNOSIS_LIMITS),
    ):
        if rows[size]:
            last = rows[size][-1]
            targets |= {f"{what}_{n}": at_most(last[n], most) for n, most in limits.items()}
    if rows["records"]:
        right = min(row["is_right"] for row in rows["records"])
        targets["diagnosis_is_right"] = at_least(right, 1.0)
    return targets


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints, and returns the exit code."""
    short = "25 rigs, journals of 200 and 1 000 trials, 70 cells, 2 and 4 records"
    parser = command_line(__doc__, quick=short)
    parser.epilog = EPILOG
    for name in SIZES:
        parser.add_argument(f"--{name}", type=int, nargs="*", help=f"numbers of {name}; or none")
    parser.add_argument("--busy", type=int, default=0, help="programs that compute beside a fleet")
    parser.add_argument("--tuner", default=FLEET_TUNER, help="tuner of a fleet")
    options = parser.parse_args(arguments)
    hold_s = QUICK_HOLD_S if options.quick else HOLD_S
    search = QUICK_SEARCH_TRIALS if options.quick else SEARCH_TRIALS
    rows: dict[str, Rows] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        measures: dict[str, Callable[[int], NamedTuple]] = {
            "rigs": lambda n: measure(n, options.tuner, hold_s, busy=options.busy, trials=search),
            "trials": lambda n: measure_journal(n, folder),
            "cells": lambda n: measure_sweep(n, folder),
            "records": measure_diagnosis,
        }
        for name, call in measures.items():
            sizes = getattr(options, name)
            sizes = SIZES[name][options.quick] if sizes is None else sizes
            rows[name] = [dict(call(size)._asdict()) for size in sizes]
    grown = {name: growth_exponents(of_name) for name, of_name in rows.items()}
    figures = {**rows, "growth exponents": {name: of for name, of in grown.items() if of}}
    return print_results(figures, targets_of(rows), as_json=options.json, tables=True)


if __name__ == "__main__":
    # Ends the daemon and the rigs, too, when it is terminated.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    sys.exit(main())
