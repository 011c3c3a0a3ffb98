"""Rates of right names for effects hidden in machines that share no code with the models here.

Cases come from `experiments.hidden_machines`. Each is diagnosed from its records alone; then the
answer is compared with what was hidden. Counted are cases whose prediction error is at least 1.5
times the noise floor, unless it says otherwise. Misnaming is any name, in a verdict of whatever
kind, of a family that is not there. Every row goes to a file as it is finished; `--rows` prints
the tables of such a file without running anything.
"""

import json
import math
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from experiments.hidden_scores import Row, Task, diagnose
from experiments.results import (
    Target,
    at_least,
    at_most,
    command_line,
    print_results,
    save_figure,
)

SHARES = {
    "plain": 26,
    "none": 12,
    "outside": 11,
    "two": 8,
    "left_out": 7,
    "noise5": 6,
    "steps_only": 4,
    "wrong_base": 4,
    "no_encoder": 4,
    "none_no_encoder": 4,
    "unloaded": 6,
    "none_unloaded": 3,
    "outside_unloaded": 3,
    "stage": 2,
}
"""Per cent of the cases."""

FIRST_SEED = 70_030
"""First seed of the validation block; experiments/hidden_machines/seeds.md lists the blocks."""

BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Edges of the probabilities whose frequencies are compared."""

OUT = Path("out")
SINGLE = ("plain", "steps_only", "wrong_base", "unloaded", "stage")
NOTHING = ("none", "none_unloaded")
OUTSIDE = ("outside", "outside_unloaded", "left_out")
QUICK_CASES, THROUGHPUT_CASES = 4, 8

LIMITS: dict[str, tuple[float, Callable[[float, float], Target]]] = {
    "exact_name": (0.95, at_least),
    "right_family": (0.98, at_least),
    "false_alarms": (0.03, at_most),
    "outside_misnamed": (0.05, at_most),
    "left_out_misnamed": (0.05, at_most),
    "median_gap_closed": (0.95, at_least),
    "median_free_run_ratio": (0.25, at_most),
    "two_both_found": (0.80, at_least),
    "noise5_wrong_names": (0.0, at_most),
    "no_encoder_false_alarms": (0.05, at_most),
    "intervals_hold_truth": (0.90, at_least),
    "calibration_error": (0.05, at_most),
    "median_cpu_s": (3.0, at_most),
    "throughput_two_workers": (1.8, at_least),
}


def tasks(cases: int, seed0: int) -> list[Task]:
    """The cases to run, their kinds mixed, so that the first of them already tell something."""
    total = sum(SHARES.values())
    counts = {variant: max(1, round(cases * n / total)) for variant, n in SHARES.items()}
    placed = [
        ((n + 0.5) / count, Task(seed0 + n, variant))
        for variant, count in counts.items()
        for n in range(count)
    ]
    return [task for _, task in sorted(placed, key=lambda at: at[0])]


def run(
    todo: list[Task],
    jobs: int,
    each: Callable[[Any], None],
    do: Callable[[Task], Any] = diagnose,
) -> float:
    """Does all of them in `jobs` processes; returns the time it took once they were up, s."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn) as pool:
        list(pool.map(time.sleep, [0.5] * jobs))  # every process has started
        start = time.perf_counter()
        for done in as_completed([pool.submit(do, task) for task in todo]):
            each(done.result())
        return time.perf_counter() - start


def run_all(todo: list[Task], jobs: int, path: Path) -> list[Row]:
    """Runs them and writes each row to the file as it is finished."""
    rows: list[Row] = []
    path.parent.mkdir(exist_ok=True)
    with path.open("w", encoding="utf-8") as file:

        def keep(row: Row) -> None:
            rows.append(row)
            file.write(json.dumps(row.as_json()) + "\n")
            file.flush()
            sign = "." if row.right or not row.truth else "!"
            print(sign, end="" if len(rows) % 80 else "\n", file=sys.stderr, flush=True)

        took = run(todo, jobs, keep)
    print(f"\n{len(rows)} cases in {took:.0f} s; rows in {path}", file=sys.stderr)
    return rows


def throughput(cases: int, seed0: int) -> dict[str, float]:
    """What two workers do per second over what one does, of diagnoses and of a mere loop.

    The loop shows what the machine itself allows.
    """
    todo = [Task(seed0 + n, "plain") for n in range(cases)]
    run(todo, 2, lambda _: None)  # everything is compiled and in the cache
    return {
        "throughput_two_workers": _two_over_one(todo, diagnose),
        "loop_two_workers": _two_over_one(todo, _loop),
    }


def _two_over_one(todo: list[Task], do: Callable[[Task], Any]) -> float:
    """The same where each of the two has all of it to do.

    So they are both at work to the end, however unlike a few cases are.
    """
    twice = [task for task in todo for _ in range(2)]
    shares = ((todo, 1), (twice, 2))
    alone, together = (
        min(run(share, jobs, lambda _: None, do) for _ in range(2)) for share, jobs in shares
    )
    return 2.0 * alone / together


def _loop(_: Task) -> int:
    """Some seconds' work for nothing but the processor."""
    return sum(n & 1 for n in range(30_000_000))


def confusion(rows: list[Row]) -> dict[str, dict[str, int]]:
    """How often what was said, by what was hidden; of one hidden effect or none."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        if row.variant in ("two", "left_out"):
            continue
        said = "+".join(row.found) if row.found else row.verdict
        if row.verdict in ("incomplete", "ambiguous") and row.found:
            said = f"{said} ({row.verdict})"
        truth = "+".join(row.truth) or "none"
        if row.truth and not row.visible:
            said = f"{said}, gap below 1.5"
        table.setdefault(truth, Counter())[said] += 1
    return {truth: dict(said.most_common()) for truth, said in sorted(table.items())}


def rate(rows: list[Row], holds: Callable[[Row], bool]) -> float:
    """Share of the rows for which it holds; nan without rows."""
    return sum(map(holds, rows)) / len(rows) if rows else math.nan


def middle(values: list[float]) -> float:
    """Median of what is finite."""
    finite = [value for value in values if math.isfinite(value)]
    return median(finite) if finite else math.nan


def of(rows: list[Row], *variants: str) -> list[Row]:
    """The rows of some variants."""
    return [row for row in rows if row.variant in variants]


def summary(rows: list[Row]) -> dict[str, float]:
    """The figures that are asked for, by name."""
    single = [row for row in of(rows, *SINGLE) if row.visible]
    plain = [row for row in of(rows, "plain") if row.visible]
    two = [row for row in of(rows, "two") if row.visible]
    both_visible = [row for row in two if row.each_visible]
    right = [row for row in single if row.right]
    held = [one.holds for row in rows if row.right for one in row.intervals]
    calibrated = [one.holds for row in rows if row.right for one in row.calibrations]
    return {
        "cases": float(len(rows)),
        "errors": float(sum(bool(row.error) for row in rows)),
        "single_visible": float(len(single)),
        "single_below_1.5_floors": float(len(of(rows, *SINGLE)) - len(single)),
        "exact_name": rate(single, lambda row: row.right),
        "right_family": rate(single, lambda row: row.right_family),
        "plain_exact_name": rate(plain, lambda row: row.right),
        **{
            f"{variant}_exact_name": rate(
                [row for row in of(rows, variant) if row.visible], lambda row: row.right
            )
            for variant in (*SINGLE[1:], "noise5", "no_encoder")
        },
        "incomplete_among_right": rate(right, lambda row: row.verdict == "incomplete"),
        "nothing_hidden": float(len(of(rows, *NOTHING))),
        "false_alarms": rate(of(rows, *NOTHING), lambda row: row.verdict != "none"),
        "no_encoder_false_alarms": rate(
            of(rows, "none_no_encoder"), lambda row: row.verdict != "none"
        ),
        "outside_misnamed": rate(of(rows, *OUTSIDE[:2]), lambda row: row.wrong_name),
        "left_out_misnamed": rate(of(rows, "left_out"), lambda row: row.wrong_name),
        "two_exact": rate(two, lambda row: row.right),
        "two_both_found": rate(two, lambda row: row.both_found),
        "two_each_visible_alone": float(len(both_visible)),
        "two_both_found_of_these": rate(both_visible, lambda row: row.both_found),
        "noise5_wrong_names": float(sum(row.wrong_name for row in of(rows, "noise5"))),
        "median_gap_closed": middle([row.gap_closed for row in right]),
        "median_free_run_ratio": middle([row.rms_ratio for row in right]),
        "intervals": float(len(held)),
        "intervals_hold_truth": sum(held) / len(held) if held else math.nan,
        "calibrations_hold_truth": sum(calibrated) / len(calibrated) if calibrated else math.nan,
        "calibration_error": calibration_error(reliability(rows)),
        "median_cpu_s": middle([row.cpu_s for row in rows]),
        "slowest_cpu_s": max((row.cpu_s for row in rows if not row.error), default=math.nan),
    }


class Reliability(NamedTuple):
    """Probabilities stated between two edges, and how often the family was there."""

    stated: float
    there: float
    number: int


def reliability(rows: list[Row]) -> list[Reliability]:
    """Stated probabilities of families against their frequencies, bin by bin."""
    stated = [one for row in rows for one in row.stated if math.isfinite(one.probability)]
    found = []
    for low, high in pairwise(BINS):
        within = [s for s in stated if low <= s.probability < high or s.probability == high == 1.0]
        if within:
            mean = sum(s.probability for s in within) / len(within)
            there = sum(s.there for s in within) / len(within)
            found.append(Reliability(mean, there, len(within)))
    return found


def calibration_error(bins: list[Reliability]) -> float:
    """Expected calibration error: mean difference of probability and frequency."""
    number = sum(one.number for one in bins)
    return sum(abs(one.stated - one.there) * one.number for one in bins) / number if bins else 0.0


def draw_reliability(bins: list[Reliability]) -> Figure:
    """Reliability diagram: frequency over stated probability."""
    figure = Figure(figsize=(4.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.7")
    axes.plot([b.stated for b in bins], [b.there for b in bins], "o-")
    for b in bins:
        axes.annotate(
            f"{b.number}", (b.stated, b.there), xytext=(4, -10), textcoords="offset points"
        )
    axes.set(xlabel="stated probability of a family", ylabel="share of cases with it")
    return figure


def show(rows: list[Row]) -> None:
    """Prints the tables."""
    print("stated probability of a family -> share of cases with it (number)\n")
    for one in reliability(rows):
        print(f"  {one.stated:.2f} -> {one.there:.2f} ({one.number})")
    print()
    print("hidden -> said, one hidden effect or none\n")
    for truth, said in confusion(rows).items():
        print(f"  {truth:22s} " + "; ".join(f"{what} {count}" for what, count in said.items()))
    print("\ntwo hidden\n")
    for row in of(rows, "two"):
        if not row.right:
            print(f"  {row.seed} {' + '.join(row.truth)}: {row.verdict} {' + '.join(row.found)}")
    print("\ntruth taken out of the catalogue\n")
    for row in of(rows, "left_out"):
        if row.wrong_name:
            print(f"  {row.seed} {row.truth[0]}: {row.verdict} {' + '.join(row.found)}")
    print("\nintervals that hold the truth\n")
    for name, holds in sorted(_by_parameter(rows)):
        print(f"  {name:40s} {sum(holds):3d} of {len(holds)}")
    for row in rows:
        if row.error:
            print(f"\n{row.variant} {row.seed}: {row.error.strip().splitlines()[-1]}")


def _by_parameter(rows: list[Row]) -> Iterator[tuple[str, list[bool]]]:
    found: dict[str, list[bool]] = {}
    for row in rows:
        if row.right:
            for one in (*row.intervals, *row.calibrations):
                found.setdefault(one.name, []).append(one.holds)
    yield from found.items()


def targets(figures: dict[str, float]) -> dict[str, Target]:
    """What has to be reached, of the figures that were measured."""
    return {
        name: judge(figures[name], limit)
        for name, (limit, judge) in LIMITS.items()
        if name in figures
    }


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick=f"{QUICK_CASES} cases, no throughput")
    parser.add_argument("--cases", type=int, default=1000, help="number of cases")
    parser.add_argument("--seed0", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--rows", type=Path, help="print the tables of this file; run nothing")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    if options.rows:
        lines = options.rows.read_text(encoding="utf-8").splitlines()
        rows = [Row.from_json(json.loads(line)) for line in lines]
    else:
        todo = tasks(options.cases, options.seed0)[: QUICK_CASES if options.quick else None]
        rows = run_all(todo, options.jobs, OUT / "hidden_effects.jsonl")
        if not options.quick:
            figures |= throughput(THROUGHPUT_CASES, options.seed0)
    figures = summary(rows) | figures
    save_figure(draw_reliability(reliability(rows)), OUT, "hidden_reliability")
    if not options.json:
        show(rows)
        print()
        for name, value in figures.items():
            print(f"  {name:30s} {value if isinstance(value, str) else f'{value:.4g}'}")
    counted = figures | {"confusion": confusion(rows)}
    return print_results(counted, targets(figures), as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
