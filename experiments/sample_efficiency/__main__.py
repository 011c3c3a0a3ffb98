"""Trials and unsafe trials that tuners need under measurement noise.

Every algorithm tunes the same problems from the same weak gains, in logarithms of the gains,
within the same bounds, and with the same noise on each numbered trial. It is scored by the
noise-free cost of the gains it recommends after each trial: its centre or mean, or else its best
noisy trial. Settings were chosen on seeds below 100; the tables are of seeds from 1000 on. Rows
are written as they are finished; `--rows` prints the tables of such a file.
"""

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from itertools import product
from pathlib import Path

from joblib import Parallel, delayed

from experiments.results import command_line, print_results
from experiments.sample_efficiency import figures, searches, tables
from experiments.sample_efficiency.algorithms import ALGORITHMS, OURS
from experiments.sample_efficiency.drawing import save_figure
from experiments.sample_efficiency.figures import MORE_NOISE, NOISE, STOPPING
from experiments.sample_efficiency.optimum import OUT, optimum
from experiments.sample_efficiency.problems import ALL_PROBLEMS, GAUGE, PROBLEMS
from experiments.sample_efficiency.searches import COLD, WARM, Job, Row
from experiments.sample_efficiency.stopping import StoppedRun, stopped_run

HELD_OUT = range(1000, 1020)
RECORDED = "model_based"
RECORDED_BUDGET = 40  # it stops by itself after 4 to 15 trials
SLOW = "skopt GP"
SLOW_SEEDS, SLOW_BUDGET = 3, 80  # a proposal takes most of a second
SEEDS_BESIDE = 10  # with gauge noise; and of peers at 10 % noise and from a warm start
STOP_NOISES = (0.01, NOISE, MORE_NOISE)
ROWS = OUT / "sample_efficiency.jsonl"
STOPS = OUT / "sample_efficiency_stops.jsonl"
FIGURE = OUT / "sample_efficiency.png"


def jobs(only: str | None, seeds: range) -> Iterator[Job]:
    """Every search of the tables, or those of one algorithm."""
    for name in ALGORITHMS if only is None else (only,):
        if name == SLOW:
            for seed, problem in product(seeds[:SLOW_SEEDS], PROBLEMS):
                yield Job(problem, name, NOISE, COLD, seed, SLOW_BUDGET)
            continue
        if name == RECORDED:
            for problem, seed in product(ALL_PROBLEMS, seeds):
                noises = (0.0,) if problem == GAUGE.name else (NOISE, MORE_NOISE)
                for noise in noises:
                    yield Job(problem, name, noise, COLD, seed, RECORDED_BUDGET)
            continue
        yield from (Job(p, name, NOISE, COLD, s, 200) for p, s in product(PROBLEMS, seeds))
        beside = seeds if name in OURS else seeds[:SEEDS_BESIDE]
        for problem, seed in product(PROBLEMS, beside):
            yield Job(problem, name, MORE_NOISE, COLD, seed, 300)
            yield Job(problem, name, NOISE, WARM, seed, 60)
        yield from (Job(GAUGE.name, name, 0.0, COLD, s, 200) for s in seeds[:SEEDS_BESIDE])


def quick_jobs() -> Iterator[Job]:
    """A few searches of every kind."""
    for name, problem, seed in product(ALGORITHMS, ("reel 0.5 m", "8 Hz"), (0, 1)):
        if name != SLOW:
            yield Job(problem, name, NOISE, COLD, seed, 20 if name == RECORDED else 60)


def run(todo: list[Job], workers: int, file: Path) -> list[Row]:
    """Runs the searches, writing each row as it is finished."""
    for problem in ALL_PROBLEMS.values():
        optimum(problem)  # cached before the workers need it
    file.parent.mkdir(exist_ok=True)
    done = []
    with file.open("a", encoding="utf-8") as rows:
        made = Parallel(n_jobs=workers, return_as="generator_unordered")(
            delayed(searches.search)(job) for job in todo
        )
        for row in made:
            done.append(row)
            rows.write(searches.written(row) + "\n")
            rows.flush()
            if len(done) % 100 == 0:
                print(f"{len(done)} of {len(todo)} searches", file=sys.stderr, flush=True)
    return done


def stops(seeds: range, problems: list[str], workers: int, file: Path | None) -> list[StoppedRun]:
    """Whole runs of safe_bayesian."""
    made = Parallel(n_jobs=workers)(
        delayed(stopped_run)(problem, STOPPING, noise, seed)
        for noise, problem, seed in product(STOP_NOISES, problems, seeds)
    )
    if file is not None:
        file.write_text("".join(json.dumps(asdict(one)) + "\n" for one in made), encoding="utf-8")
    return list(made)


def read_stops(file: Path) -> list[StoppedRun]:
    """The runs of a file, if it exists."""
    if not file.exists():
        return []
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return [StoppedRun(**{**row, "gains_inside": tuple(row["gains_inside"])}) for row in rows]


def main() -> int:
    """Runs the searches and prints their tables; returns 1 if a target is missed."""
    parser = command_line(__doc__, quick="two problems, 60 trials, two seeds")
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument(
        "--only", choices=[*ALGORITHMS, "stops"], help="run these rows again, keep the others"
    )
    parser.add_argument("--seeds", type=int, help="seeds of every search; keep no rows")
    parser.add_argument("--rows", type=Path, help="print the tables of this file, run nothing")
    options = parser.parse_args()
    if options.rows:
        rows, ends = searches.read(options.rows), read_stops(STOPS)
    elif options.quick:
        rows = run(list(quick_jobs()), options.jobs, Path(os.devnull))
        ends = stops(range(2), ["8 Hz"], options.jobs, None)
    elif options.seeds:
        seeds = HELD_OUT[: options.seeds]
        rows = run(list(jobs(options.only, seeds)), options.jobs, Path(os.devnull))
        ends = stops(seeds, list(PROBLEMS), options.jobs, None)
    else:
        if options.only is None:
            ROWS.unlink(missing_ok=True)
        if options.only != "stops":
            run(list(jobs(options.only, HELD_OUT)), options.jobs, ROWS)
        if options.only in (None, STOPPING, "stops"):
            stops(HELD_OUT, list(PROBLEMS), options.jobs, STOPS)
        rows, ends = searches.read(ROWS), read_stops(STOPS)
    compared, stopped = figures.of_all(rows), figures.of_stops(ends)
    image = FIGURE.with_stem(f"{FIGURE.stem}_quick") if options.quick else FIGURE
    save_figure(rows, image)
    if not options.json:
        for line in (*tables.lines(compared), *tables.stop_lines(stopped)):
            print(line)
        print(f"figure: {image}")
    reached = figures.targets(compared, stopped)
    return print_results({**compared, "stops": stopped}, reached, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
