"""Figures of the rows per problem and algorithm, and the targets."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from experiments.results import Target, at_least, at_most
from experiments.sample_efficiency.algorithms import ALGORITHMS, OURS
from experiments.sample_efficiency.problems import ALL_PROBLEMS, PROBLEMS
from experiments.sample_efficiency.searches import SearchRow, select
from experiments.sample_efficiency.trials import COLD, WARM

DEFAULT = OURS[0]
NOISE, MORE_NOISE = 0.03, 0.10
ARRIVAL_TRIALS = 40
"""Trials within which a search should come near the optimum."""

SHARE_WON = 5.0 / 6.0
"""Share of the problems on which every peer must need more trials."""


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile by rank, so that infinite values are allowed."""
    ranked = sorted(values)
    places = (0.25, 0.5, 0.75)
    lower, middle, upper = (ranked[round(p * (len(ranked) - 1))] for p in places)
    if len(ranked) % 2 == 0:
        a, b = ranked[len(ranked) // 2 - 1], ranked[len(ranked) // 2]
        middle = b if math.isinf(b) else 0.5 * (a + b)
    return lower, middle, upper


def median(values: Sequence[float]) -> float:
    """The median; infinite if a middle value is."""
    return quartiles(values)[1] if values else math.nan


def of_algorithm(rows: Iterable[SearchRow], problem: str, algorithm: str) -> dict[str, Any]:
    """Figures of an algorithm on a problem, as far as there are rows."""
    mine = select(rows, problem=problem, algorithm=algorithm)
    noise = 0.0 if ALL_PROBLEMS[problem].gauge_noise else NOISE
    usual = select(mine, noise=noise, start=COLD)
    figures: dict[str, Any] = {}
    if usual:
        figures |= {
            "seeds": len(usual),
            "budget": len(usual[0].excess),
            "first": median([row.first_near for row in usual]),
            "first_quartiles": quartiles([row.first_near for row in usual])[::2],
            "stays": median([row.stays_near for row in usual]),
            "unsafe": median([row.unsafe for row in usual]),
            "unsafe_worst": max(row.unsafe for row in usual),
            "arrived": sum(row.first_near <= ARRIVAL_TRIALS for row in usual),
            "unsafe_repeatedly": sum(row.unsafe > 1 for row in usual),
            "seconds": median([row.seconds for row in usual]),
        }
        for trials in (100, 200):
            if len(usual[0].excess) >= trials:
                figures[f"excess_{trials}"] = median([row.excess_after(trials) for row in usual])
    if more := select(mine, noise=MORE_NOISE, start=COLD):
        figures["seeds_beside"] = len(more)
        figures["more_noise_first"] = median([row.first_near for row in more])
        figures["more_noise_excess"] = median([row.excess[-1] for row in more])
        figures["more_noise_unsafe_worst"] = max(row.unsafe for row in more)
    if warm := select(mine, noise=NOISE, start=WARM):
        figures["warm_first"] = median([row.first_near for row in warm])
    return figures


def of_all(rows: Sequence[SearchRow]) -> dict[str, dict[str, dict[str, Any]]]:
    """Figures of every problem and algorithm with rows."""
    figures = {
        problem: {name: own for name in ALGORITHMS if (own := of_algorithm(rows, problem, name))}
        for problem in ALL_PROBLEMS
    }
    return {problem: own for problem, own in figures.items() if own}


def is_won(own: dict[str, dict[str, Any]]) -> bool:
    """Whether the default tuner arrives on a problem, and before every peer that arrives."""
    ours = own[DEFAULT].get("first", math.inf)
    peers = [f["first"] for name, f in own.items() if name not in OURS and "first" in f]
    return math.isfinite(ours) and all(n > ours for n in peers)


def targets(figures: dict[str, dict[str, dict[str, Any]]]) -> dict[str, Target]:
    """Targets of the default tuner on the problems with noise on the cost."""
    families = {p: own for p, own in figures.items() if p in PROBLEMS and DEFAULT in own}
    rows: dict[str, Target] = {}
    for key, most, what in WORST_FAMILY:
        values = [own[DEFAULT][key] for own in families.values() if key in own[DEFAULT]]
        if values:
            rows[f"{what}, worst family"] = at_most(max(values), most)
    compared = [own for own in families.values() if set(own) - set(OURS)]
    if compared:
        won = sum(map(is_won, compared)) / len(compared)
        rows["share of families on which every peer needs more trials"] = at_least(won, SHARE_WON)
    return rows


WORST_FAMILY = (
    ("first", ARRIVAL_TRIALS, "trials until within 5 %, median"),
    ("stays", 60.0, "trials from which it stays within 5 %, median"),
    ("excess_200", 0.003, "excess after 200 trials, median"),
    ("more_noise_excess", 0.015, "excess after 300 at 10 % noise, median"),
    ("unsafe", 0.0, "unsafe trials, median"),
    ("unsafe_worst", 1.0, "unsafe trials, worst seed"),
    ("warm_first", 15.0, "trials from a warm start, median"),
)
"""Figures of the default tuner on the worst family: key, limit, description."""
