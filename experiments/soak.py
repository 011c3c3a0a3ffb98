"""Does anything grow in 24 hours of trials?

A client process runs one tuning after another on a simulated rig in a process of its own
(`estune serve`), over the link, with the rig's ledger and each run's journal on disk. After every
tuning the memory and the open files of both processes, and the size of the files, are recorded.
"""

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

from estune import api
from estune.remote.ledger import FRAMES_MAX_BYTES
from estune.run.journal import FILE_NAME
from estune.support.child_process import child_process, next_line
from experiments.results import at_most, command_line, print_results

DAY = 100_000
BESIDE_SEARCH = 9
ONE_ARENA = {"MALLOC_ARENA_MAX": "1"}
"""One arena for all threads: memory then does not depend on which thread serves a request."""

STRINGS_KEPT = 16_384
"""Short strings that Pydantic caches. Each trial brings new ones: either process grows by 1.5 MB
over some twice as many trials, and then no further."""

GROWTH_LIMIT = 0.05
"""Greatest relative growth between the first and the last third of the run."""


class Use(NamedTuple):
    """Private memory of a process that it has written to, and its open files and sockets."""

    memory_bytes: int
    open_files: int

    @classmethod
    def of(cls, pid: int) -> Self:
        """The present use of a process."""
        # Memory that it only reads, such as a library, may be shared or not as others come and go.
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
        rows = [line.split() for line in text.splitlines()]
        memory = next(1024 * int(row[1]) for row in rows if row[0] == "Private_Dirty:")
        return cls(memory, len(list(Path(f"/proc/{pid}/fd").iterdir())))


class ResourceSample(NamedTuple):
    """Resources of both processes, and file sizes, after so many trials."""

    trials: int
    at_s: float
    client: Use
    rig: Use
    journal_bytes: int
    ledger_bytes: int


def work(endpoint: str, folder: Path, trials: int, per_run: int) -> None:
    """Tunes repeatedly; prints the number of trials and the file size of each, and deletes it."""
    for number in range(trials // per_run):
        run = folder / f"run{number}"
        api.tune(
            endpoint,
            tuner=("otis", "least_squares_gradient")[number % 2],
            trials=per_run - BESIDE_SEARCH,
            run=run.name,
            folder=folder,
            watch=None,
        )
        print(len(api.load(run).entries), (run / FILE_NAME).stat().st_size, flush=True)
        sampled = sys.stdin.readline()
        shutil.rmtree(run)
        if not sampled:
            return


def soak(trials: int, per_run: int, folder: Path) -> Iterator[ResourceSample]:
    """Runs so many trials; yields a sample after each tuning."""
    ledger = folder / "rig.ledger"
    serving = ("estune", "serve", "--ledger", str(ledger), "--stop-on-eof")
    settings: dict[str, Any] = {"end_within_s": 10.0, "env": os.environ | ONE_ARENA}
    with child_process(*serving, **settings) as rig:
        endpoint = next_line(rig).split()[-1]
        tuning = ("experiments.soak", "--client", endpoint, "--folder", str(folder))
        counts = ("--trials", str(trials), "--per-run", str(per_run))
        with child_process(*tuning, *counts, **settings) as client:
            began_s, total = time.monotonic(), 0
            for _ in range(trials // per_run):
                count, size = map(int, next_line(client).split())
                total += count
                yield ResourceSample(
                    total,
                    time.monotonic() - began_s,
                    *(Use.of(client.pid), Use.of(rig.pid)),
                    size,
                    ledger.stat().st_size,
                )
                if client.stdin:
                    client.stdin.write("\n")
                    client.stdin.flush()


def growth(values: list[int], settled: int) -> float:
    """Relative growth from the first to the last third, from `settled` on."""
    values = values[settled:]
    third = max(len(values) // 3, 1)
    return statistics.median(values[-third:]) / statistics.median(values[:third]) - 1.0


def figures_of(samples: list[ResourceSample], per_run: int) -> dict[str, Any]:
    """Figures of the experiment."""
    last = samples[-1]
    # The ledger holds the newest records, and Pydantic the newest strings; memory is steady only
    # once both are full.
    per_record = last.ledger_bytes / min(last.trials, FRAMES_MAX_BYTES / 25_000)
    filled = max(FRAMES_MAX_BYTES / per_record, 2.0 * STRINGS_KEPT)
    settled = min(int(filled / per_run) + 1, len(samples) // 3)
    half, use = samples[len(samples) // 2 :], {}
    late = [sample.trials for sample in half]
    for who in ("client", "rig"):
        for what in Use._fields:
            values = [getattr(getattr(sample, who), what) for sample in samples]
            line = statistics.linear_regression(late, values[-len(half) :])
            use[f"{who}, {what}"] = {
                "first": values[0],
                "last": values[-1],
                "growth": growth(values, settled),
                "per_trial_late": line.slope,
            }
    return {
        "trials": last.trials,
        "seconds": last.at_s,
        "trials_per_second": last.trials / last.at_s,
        "journal_bytes_per_trial": sum(s.journal_bytes for s in samples) / last.trials,
        "ledger_bytes": last.ledger_bytes,
        "use": use,
    }


def main() -> int:
    """Runs the experiment, and prints the table or, with --json, the figures; the exit code."""
    parser = command_line(__doc__, quick="a few tunings only")
    parser.add_argument("--trials", type=int, default=DAY)
    parser.add_argument("--per-run", type=int, default=1000, help="trials of each tuning")
    parser.add_argument("--folder", type=Path, help="on which disk to keep journals and ledger")
    parser.add_argument("--client", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    trials, per_run = (1200, 60) if arguments.quick else (arguments.trials, arguments.per_run)
    if arguments.client:
        work(arguments.client, arguments.folder, arguments.trials, arguments.per_run)
        return 0
    samples = []
    with tempfile.TemporaryDirectory(prefix="estune-soak-", dir=arguments.folder) as folder:
        for sample in soak(trials, per_run, Path(folder)):
            samples.append(sample)
            print(f"{sample.trials} trials, {sample.at_s:.0f} s", file=sys.stderr, flush=True)
    figures = figures_of(samples, per_run)
    targets = {
        f"growth of {name}": at_most(row["growth"], GROWTH_LIMIT)
        for name, row in figures["use"].items()
    }
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
