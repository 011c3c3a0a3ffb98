"""How many trials, and unsafe trials, do our tuners and other optimisers need on eight families?

Command: `python -m experiments.sample_efficiency`.
Target: the default tuner: limits of trials and excess on the worst family, no unsafe trial in the
median.

Every algorithm tunes the same problems from the same weak gains, in logarithms of the gains,
within the same bounds, and with the same noise on each numbered trial. It is scored by the
noise-free cost of the gains it recommends after each trial: its centre or mean, or else its best
noisy trial. Settings were chosen on seeds below 100; the tables are of seeds from 1000 on.
"""

import contextlib
import math
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

from joblib import Parallel, delayed

from experiments.results import Target, at_least, at_most, command_line, print_results
from experiments.sample_efficiency.algorithms import ALGORITHMS, FROM_THE_MODEL, OURS
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.sample_efficiency.trials import Job, Spent, Trials

FIRST_SEED, SEEDS = 1000, 20
BUDGET, QUICK_BUDGET = 200, 60
BUDGETS = {"model_based": 40, "skopt GP": 80}
"""Of the tuner that stops by itself after 4 to 15 trials, and of one that takes most of a second
to propose."""

SLOW_SEEDS = {"skopt GP": 3}
NEAR = 0.05
"""Excess cost at which a search has arrived at the optimum."""

ARRIVAL_TRIALS = 40
"""Trials within which a search should arrive."""

SHARE_WON = 5.0 / 6.0
"""Share of the problems on which every peer must need more trials."""

WORST_FAMILY = (
    ("first", ARRIVAL_TRIALS, "trials until within 5 %, median"),
    ("stays", 60.0, "trials from which it stays within 5 %, median"),
    ("excess", 0.003, "excess at the end, median"),
    ("unsafe", 0.0, "unsafe trials, median"),
    ("unsafe_worst", 1.0, "unsafe trials, worst seed"),
)
"""Figures of the default tuner on the worst family: key, limit, description."""


class SearchRow(NamedTuple):
    """The result of a search.

    Attributes:
        job: The settings.
        excess: Noise-free cost of the recommended gains after each trial, over that of the
            optimum, less one.
        unsafe: Number of unsafe trials.
        seconds: Duration, simulated trials included.
    """

    job: Job
    excess: tuple[float, ...]
    unsafe: int
    seconds: float

    @property
    def first_near(self) -> float:
        """Trials until the recommended gains are near the optimum; infinite if never."""
        return next((k for k, e in enumerate(self.excess, 1) if e <= NEAR), math.inf)

    @property
    def stays_near(self) -> float:
        """Trials from which on they stay near; infinite if they do not."""
        far = [k for k, e in enumerate(self.excess, 1) if not e <= NEAR]
        last = far[-1] if far else 0
        return last + 1 if last < len(self.excess) else math.inf


def search(job: Job) -> SearchRow:
    """Runs a search."""
    trials = Trials(job)
    began_s = time.perf_counter()
    # Warnings of the libraries do not concern the comparison.
    with contextlib.suppress(Spent), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ALGORITHMS[job.algorithm](trials)
    seconds = time.perf_counter() - began_s
    excess = trials.settled_costs() / optimum(trials.problem).cost - 1.0
    return SearchRow(job, tuple(excess.tolist()), trials.unsafe, seconds)


def jobs(seeds: int) -> Iterator[Job]:
    """Every search of the tables."""
    for name, problem in product(ALGORITHMS, PROBLEMS):
        for seed in range(min(seeds, SLOW_SEEDS.get(name, seeds))):
            yield Job(problem, name, FIRST_SEED + seed, BUDGETS.get(name, BUDGET))


def quick_jobs() -> Iterator[Job]:
    """A few searches of every kind."""
    for name, problem, seed in product(ALGORITHMS, ("reel 0.5 m", "8 Hz"), (0, 1)):
        if name not in SLOW_SEEDS:
            yield Job(problem, name, seed, min(BUDGETS.get(name, BUDGET), QUICK_BUDGET))


def median(values: Sequence[float]) -> float:
    """Median by rank, so that infinite values are allowed: infinite if a middle value is."""
    ranked = sorted(values)
    low, high = ranked[(len(ranked) - 1) // 2], ranked[len(ranked) // 2]
    return low if low == high else 0.5 * (low + high)


def figures_of(rows: Sequence[SearchRow]) -> dict[str, float]:
    """Figures of an algorithm on a problem."""
    return {
        "seeds": len(rows),
        "budget": rows[0].job.budget,
        "first": median([row.first_near for row in rows]),
        "stays": median([row.stays_near for row in rows]),
        "excess": median([row.excess[-1] for row in rows]),
        "unsafe": median([row.unsafe for row in rows]),
        "unsafe_worst": max(row.unsafe for row in rows),
        "unsafe_repeatedly": sum(row.unsafe > 1 for row in rows),
        "arrived": sum(row.first_near <= ARRIVAL_TRIALS for row in rows),
        "seconds": median([row.seconds for row in rows]),
    }


def is_won(own: dict[str, dict[str, float]]) -> bool:
    """Whether the default tuner arrives on a problem, and before every peer by the cost alone."""
    ours = own[OURS[0]]["first"]
    peers = [f["first"] for name, f in own.items() if name not in (*OURS, *FROM_THE_MODEL)]
    return math.isfinite(ours) and all(n > ours for n in peers)


def targets(families: dict[str, dict[str, dict[str, float]]]) -> dict[str, Target]:
    """Targets of the default tuner."""
    found = {
        f"{what}, worst family": at_most(max(f[OURS[0]][key] for f in families.values()), most)
        for key, most, what in WORST_FAMILY
    }
    won = sum(map(is_won, families.values())) / len(families)
    name = "share of families on which every peer by the cost alone needs more trials"
    return found | {name: at_least(won, SHARE_WON)}


def main() -> int:
    """Runs the searches and prints their tables; returns 1 if a target is missed."""
    parser = command_line(__doc__, quick="two problems, 60 trials, two seeds")
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="seeds of every search")
    options = parser.parse_args()
    todo = list(quick_jobs() if options.quick else jobs(options.seeds))
    for problem in {job.problem: PROBLEMS[job.problem] for job in todo}.values():
        optimum(problem)  # cached before the workers need it
    rows: dict[str, dict[str, list[SearchRow]]] = defaultdict(lambda: defaultdict(list))
    for row in Parallel(n_jobs=options.jobs, return_as="generator")(map(delayed(search), todo)):
        rows[row.job.problem][row.job.algorithm].append(row)
    figures: dict[str, Any] = {
        problem: {name: figures_of(of_name) for name, of_name in of_problem.items()}
        for problem, of_problem in rows.items()
    }
    return print_results(figures, targets(figures), as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
