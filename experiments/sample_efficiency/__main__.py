"""How many trials, and unsafe trials, do our tuners and other optimisers need on eight families?

Command: `python -m experiments.sample_efficiency`.
Target: the default tuner: limits of trials and excess on the worst family, no unsafe trial in the
median.

Every algorithm tunes the same problems from the same weak gains, in logarithms of the gains,
within the same bounds, and with the same noise on each numbered trial. It is scored by the
noise-free cost of the gains it recommends after each trial: its centre or mean, or else its best
noisy trial. Settings were chosen on seeds below 100; the tables are of seeds from 1000 on.
"""

import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

from joblib import Parallel, delayed

from experiments.results import command_line, print_results
from experiments.sample_efficiency import figures, searches
from experiments.sample_efficiency.algorithms import ALGORITHMS, OURS
from experiments.sample_efficiency.figures import MORE_NOISE, NOISE
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import ALL_PROBLEMS, GAUGE, PROBLEMS
from experiments.sample_efficiency.searches import SearchRow
from experiments.sample_efficiency.trials import COLD, WARM, Job

HELD_OUT = range(1000, 1020)
RECORDED = "model_based"
RECORDED_BUDGET = 40  # it stops by itself after 4 to 15 trials
SLOW = "skopt GP"
SLOW_SEEDS, SLOW_BUDGET = 3, 80  # a proposal takes most of a second
SEEDS_BESIDE = 10  # with gauge noise; and of peers at 10 % noise and from a warm start


def jobs(seeds: range) -> Iterator[Job]:
    """Every search of the tables."""
    for name in ALGORITHMS:
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


def run(todo: list[Job], workers: int, file: Path | None) -> list[SearchRow]:
    """Runs the searches but those of a file, to which each row is added as it is finished."""
    for problem in ALL_PROBLEMS.values():
        optimum(problem)  # cached before the workers need it
    rows = searches.read(file) if file else []
    left = set(todo) - {row.job for row in rows}
    made = Parallel(n_jobs=workers, return_as="generator_unordered")(
        delayed(searches.search)(job) for job in todo if job in left
    )
    for row in made:
        rows.append(row)
        if file:
            searches.add(row, file)
        if len(rows) % 100 == 0:
            print(f"{len(rows)} of {len(todo)} searches", file=sys.stderr, flush=True)
    return rows


def main() -> int:
    """Runs the searches and prints their tables; returns 1 if a target is missed."""
    parser = command_line(__doc__, quick="two problems, 60 trials, two seeds")
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument("--seeds", type=int, default=len(HELD_OUT), help="seeds of every search")
    parser.add_argument(
        "--rows", type=Path, help="keep finished searches in this file, and do not run them again"
    )
    options = parser.parse_args()
    todo = quick_jobs() if options.quick else jobs(HELD_OUT[: options.seeds])
    compared = figures.of_all(run(list(todo), options.jobs, options.rows))
    reached = figures.targets(compared)
    return print_results(compared, reached, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
