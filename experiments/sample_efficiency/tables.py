"""The printed tables."""

import math
from collections.abc import Iterator
from typing import Any

from experiments.sample_efficiency.algorithms import OURS
from experiments.sample_efficiency.figures import DEFAULT, STOPPING, is_won, peers_ahead
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import ALL_PROBLEMS, PROBLEMS

HEAD = (
    f"{'':24s} {'within 5 %':>19s} {'stays':>6s} {'after':>7s} {'after':>7s} {'unsafe':>9s} "
    f"{'10 %:':>6s} {'after':>7s} {'warm':>6s}\n"
    f"{'':24s} {'median [quartiles]':>19s} {'from':>5s} {'100':>7s} {'200':>7s} {'med/worst':>9s} "
    f"{'5 %':>6s} {'300':>7s} {'start':>6s}"
)


COUNTS = {
    "first": "3 % noise",
    "more_noise_first": "10 % noise",
    "warm_first": "from the warm start",
}


def lines(figures: dict[str, dict[str, dict[str, Any]]]) -> Iterator[str]:
    """One table for each problem, and the wins and losses as sentences."""
    for problem, own in figures.items():
        best = optimum(ALL_PROBLEMS[problem])
        seeds = max(f.get("seeds", 0) for f in own.values())
        beside = min((f["seeds_beside"] for f in own.values() if "seeds_beside" in f), default=0)
        fewer = f", {beside} for peers at 10 % and warm" * (0 < beside < seeds)
        yield (
            f"\n{problem}: {ALL_PROBLEMS[problem].title}; the start costs "
            f"{best.start_cost / best.cost:.1f} times the optimum; {seeds} seeds{fewer}"
        )
        yield HEAD
        for name, row in own.items():
            yield _line(name, row, seeds)
    yield ""
    yield from _words(figures)


def stop_lines(stops: dict[str, dict[str, Any]]) -> Iterator[str]:
    """The table of complete runs."""
    if not stops:
        return
    yield f"\ncomplete runs of {STOPPING}: search, stopping rule, confirmation"
    yield (
        f"{'noise':>6s} {'runs':>5s} {'stopped':>8s} {'search':>7s} {'all':>6s} "
        f"{'excess: median':>14s} {'worst':>7s} {'improved':>9s} "
        f"{'covered: change':>15s} {'gains':>7s}"
    )
    for noise, f in stops.items():
        yield (
            f"{noise:>6s} {f['runs']:5d} {f['by_itself']:8.0%} {f['searched']:7.0f} "
            f"{f['trials']:6.0f} {f['excess']:14.2%} {f['excess_worst']:7.1%} "
            f"{f['improved']:9.0%} {_share(f['change_coverage']):>15s} "
            f"{_share(f['gain_coverage']):>7s}"
        )


def _line(name: str, f: dict[str, Any], seeds: int) -> str:
    budget = f.get("budget", 0)
    lower, upper = (_trials(n, budget) for n in f.get("first_quartiles", (math.nan,) * 2))
    band = f"{_trials(f.get('first', math.nan), budget)} [{lower}, {upper}]"
    fewer = f"  ({f['seeds']} seeds)" if f.get("seeds", seeds) < seeds else ""
    unsafe = f"{f['unsafe']:.0f}/{f['unsafe_worst']}" if "unsafe" in f else ""
    more_first = _trials(f.get("more_noise_first", math.nan), 300)
    return (
        f"{name:24s} {band:>19s} {_trials(f.get('stays', math.nan), budget):>6s} "
        f"{_excess(f, 'excess_100')} {_excess(f, 'excess_200')} {unsafe:>9s} "
        f"{more_first:>6s} {_excess(f, 'more_noise_excess')} "
        f"{_trials(f.get('warm_first', math.nan), 60):>6s}{fewer}"
    )


def _words(figures: dict[str, dict[str, dict[str, Any]]]) -> Iterator[str]:
    """Problems on which a peer needs no more trials, or has fewer unsafe ones."""
    families = [p for p in figures if p in PROBLEMS and DEFAULT in figures[p]]
    won = sum(is_won(figures[problem]) for problem in families)
    if families:
        yield f"{DEFAULT} needs fewer trials than every peer on {won} of {len(families)} families"
    for problem in families:
        for key, when in COUNTS.items():
            ours = figures[problem][DEFAULT].get(key, math.nan)
            for name, n in peers_ahead(figures[problem], key).items():
                against = "that does not arrive" if math.isinf(ours) else f"with {ours:.0f}"
                over = f"over {DEFAULT} {against}"
                yield f"{problem}, {when}: {name} wins with {n:.0f} trials {over}"
    for problem in families:
        own = figures[problem]
        safer = [
            name
            for name, f in own.items()
            if name not in OURS and f["unsafe_worst"] < own[DEFAULT]["unsafe_worst"]
        ]
        if safer:
            yield f"{problem}: fewer unsafe trials in the worst seed: {', '.join(safer)}"


def _trials(n: float, budget: int) -> str:
    if math.isnan(n):
        return ""
    return f">{budget}" if math.isinf(n) else f"{n:.0f}"


def _excess(figures: dict[str, Any], key: str) -> str:
    if key not in figures:
        return " " * 7
    return f"{figures[key]:7.1%}" if figures[key] < 10.0 else " >1000%"


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.1%}"
