"""What do 200 rigs, a long run, a large sweep and many records cost, and how does that grow?

Command: `python -m experiments.scale --rigs 10 25 50 100 200 --trials --cells --records`.
Target: no lease lost; limits of time and memory for a fleet, a journal, a sweep and a diagnosis,
which is right.

A daemon tunes and holds fleets of rigs (`fleet.py`); a journal, a sweep and a folder of records
are made at each size and read (`journal.py`, `sweep.py`, `records.py`). Times are process times,
of whole commands with the start of Python.
"""

import math
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.results import Target, at_least, at_most, command_line, print_results
from experiments.scale import fleet
from experiments.scale.journal import measure_journal
from experiments.scale.records import measure_diagnosis
from experiments.scale.sweep import measure_sweep

SIZES = {
    "rigs": ((10, 25, 50, 100, 200), (25,)),
    "trials": ((1_000, 10_000, 100_000), (200, 1_000)),
    "cells": ((700, 7_000, 100_000), (70,)),
    "records": ((10, 20, 40, 80), (2, 4)),
}
"""Sizes of fleets, journals, sweeps and diagnoses, in the full and in the short form."""

QUICK_HOLD_S = 5.0
QUICK_SEARCH_TRIALS = 4
EPILOG = (
    "The full form holds fleets of 10 to 200 rigs, and makes journals of up to 100 000 trials "
    "(1 GB) and sweeps of up to 100 000 cells (0.5 GB) in a temporary folder."
)
LIMITS = {"show_s": 1.5, "resume_s": 4.0, "parquet_s": 60.0, "bytes_per_trial": 10_000.0}
SWEEP_MB_MAX = 200.0
DIAGNOSIS_LIMITS = {"cpu_s": 60.0, "memory_MB": 1000.0}
"""Limits for the most records."""

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
        for name, most in fleet.LIMITS.items()
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
    parser.add_argument("--tuner", default=fleet.TUNER, help="tuner of a fleet")
    options = parser.parse_args(arguments)
    hold_s = QUICK_HOLD_S if options.quick else fleet.HOLD_S
    search = QUICK_SEARCH_TRIALS if options.quick else fleet.SEARCH_TRIALS
    rows: dict[str, Rows] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        measures: dict[str, Callable[[int], NamedTuple]] = {
            "rigs": lambda n: fleet.measure(
                n, options.tuner, hold_s, busy=options.busy, trials=search
            ),
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
