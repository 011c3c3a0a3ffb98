"""The figures, from the rows: per problem and algorithm, of the stop rule, and the targets."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from experiments.sample_efficiency.algorithms import ALGORITHMS, OURS
from experiments.sample_efficiency.problems import ALL_PROBLEMS, PROBLEMS
from experiments.sample_efficiency.searches import COLD, WARM, Row, of
from experiments.sample_efficiency.stopping import StoppedRun

NEWTON = OURS[0]
NOISE, MORE_NOISE = 0.03, 0.10
SHARE_WON = 5.0 / 6.0
"""On this share of the problems no peer may need as few trials."""


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
    """The middle one; of an even number the mean of the two, or infinity if one is."""
    return quartiles(values)[1] if values else math.nan


def of_algorithm(rows: Iterable[Row], problem: str, algorithm: str) -> dict[str, Any]:
    """What an algorithm does on a problem; what was not run is not there."""
    mine = of(rows, problem=problem, algorithm=algorithm)
    noise = 0.0 if ALL_PROBLEMS[problem].gauge_noise else NOISE
    usual = of(mine, noise=noise, start=COLD)
    found: dict[str, Any] = {}
    if usual:
        found |= {
            "seeds": len(usual),
            "budget": len(usual[0].excess),
            "first": quartiles([row.first_near for row in usual]),
            "stays": median([row.stays_near for row in usual]),
            "unsafe": median([row.unsafe for row in usual]),
            "unsafe_worst": max(row.unsafe for row in usual),
            "seconds": median([row.seconds for row in usual]),
        }
        for trials in (100, 200):
            if len(usual[0].excess) >= trials:
                found[f"excess_{trials}"] = median([row.excess_after(trials) for row in usual])
    if more := of(mine, noise=MORE_NOISE, start=COLD):
        found["seeds_beside"] = len(more)
        found["more_noise_first"] = median([row.first_near for row in more])
        found["more_noise_excess"] = median([row.excess[-1] for row in more])
        found["more_noise_unsafe_worst"] = max(row.unsafe for row in more)
    if warm := of(mine, noise=NOISE, start=WARM):
        found["warm_first"] = median([row.first_near for row in warm])
    return found


def of_all(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """The same for every problem and algorithm that there are rows of."""
    found = {
        problem: {name: of_algorithm(rows, problem, name) for name in ALGORITHMS}
        for problem in ALL_PROBLEMS
    }
    kept = {p: {name: f for name, f in own.items() if f} for p, own in found.items()}
    return {problem: own for problem, own in kept.items() if own}


def peers_ahead(own: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The peers that need as few trials as newton or fewer on a problem, and how many."""
    ours = own[NEWTON]["first"][1]
    peers = {name: f["first"][1] for name, f in own.items() if name not in OURS}
    return {name: n for name, n in peers.items() if n <= ours}


def of_stops(runs: Sequence[StoppedRun]) -> dict[str, dict[str, Any]]:
    """The stop rule, confirmation and intervals, by noise."""
    found = {}
    for noise in sorted({run.noise for run in runs}):
        here = [run for run in runs if run.noise == noise]
        changes = [run.change_inside for run in here if run.change_inside is not None]
        gains = [inside for run in here for inside in run.gains_inside]
        found[f"{noise:.0%}"] = {
            "runs": len(here),
            "by_itself": float(np.mean([run.by_itself for run in here])),
            "searched": median([run.searched for run in here]),
            "trials": median([run.trials for run in here]),
            "excess": median([run.excess for run in here]),
            "excess_worst": max(run.excess for run in here),
            "improved": float(np.mean([run.improved for run in here])),
            "change_coverage": float(np.mean(changes)) if changes else None,
            "gain_coverage": float(np.mean(gains)) if gains else None,
        }
    return found


def targets(
    found: dict[str, dict[str, dict[str, Any]]], stops: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """What has to be reached, of newton on the problems whose noise is on the cost."""
    families = {p: own for p, own in found.items() if p in PROBLEMS and NEWTON in own}
    rows: dict[str, tuple[float | None, float | list[float], bool]] = {}

    def worst(what: str, key: str, limit: float) -> None:
        values = [own[NEWTON][key] for own in families.values() if key in own[NEWTON]]
        if values:
            rows[what] = (max(values), limit, max(values) <= limit)

    for own in families.values():
        own[NEWTON]["first_median"] = own[NEWTON]["first"][1]
    worst("trials until within 5 %, median, worst family", "first_median", 40)
    worst("trials from which it stays within 5 %, median, worst family", "stays", 60)
    worst("excess after 200 trials, median, worst family", "excess_200", 0.003)
    worst("excess after 300 at 10 % noise, median, worst family", "more_noise_excess", 0.015)
    worst("unsafe trials, median, worst family", "unsafe", 0)
    worst("unsafe trials, worst seed", "unsafe_worst", 1)
    worst("trials from a warm start, median, worst family", "warm_first", 15)
    compared = [own for own in families.values() if set(own) - set(OURS)]
    if compared:
        won = sum(not peers_ahead(own) for own in compared) / len(compared)
        rows["share of families on which every peer needs more trials"] = (
            *(won, SHARE_WON),
            won >= SHARE_WON,
        )
    usual = stops.get(f"{NOISE:.0%}")
    if usual:
        rows["excess at the stop, median"] = (usual["excess"], 0.01, usual["excess"] <= 0.01)
        worst_stop = usual["excess_worst"]
        rows["excess at the stop, worst"] = (worst_stop, 0.05, worst_stop <= 0.05)
        for key, what in (("change", "of the change"), ("gain", "of each gain")):
            share = usual[f"{key}_coverage"]
            met = share is not None and 0.93 <= share <= 0.97
            rows[f"coverage of the 95 % interval {what}"] = (share, [0.93, 0.97], met)
    return {
        name: {"value": value, "limit": limit, "met": bool(met)}
        for name, (value, limit, met) in rows.items()
    }
