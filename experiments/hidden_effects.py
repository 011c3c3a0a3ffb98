"""Does `explain` name an effect hidden in machines that share no code with it, and only such?

Command: `python -m experiments.hidden_effects --cases 380 --seed0 70200`.
Target: 95 % named exactly, 98 % by family, at most 3 % false alarms and 5 % wrong names.

Cases come from `experiments.hidden_machines`. Each is diagnosed from its records alone; then the
answer is compared with what was hidden. Counted are cases whose prediction error is at least 1.5
times the noise floor, unless it says otherwise. Misnaming is any name, in a verdict of whatever
kind, of a family that is not there. Every row goes to a file as it is finished; `--into` continues
such a file, `--rows` prints its tables without running anything.
"""

import json
import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from experiments.hidden_scores import DiagnosisTask, Row, diagnose
from experiments.hidden_tables import confidence, confusion, show, summary
from experiments.results import Target, at_least, at_most, command_line, print_results

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

OUT = Path("out")
QUICK_CASES = 4

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
}


def tasks(cases: int, seed0: int) -> list[DiagnosisTask]:
    """The cases to run, their kinds mixed, so that the first of them already tell something."""
    total = sum(SHARES.values())
    counts = {variant: max(1, round(cases * n / total)) for variant, n in SHARES.items()}
    placed = [
        ((n + 0.5) / count, DiagnosisTask(seed0 + n, variant))
        for variant, count in counts.items()
        for n in range(count)
    ]
    return [task for _, task in sorted(placed, key=lambda at: at[0])]


def read_rows(path: Path) -> list[Row]:
    """The rows of a file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [Row.from_json(json.loads(line)) for line in lines]


def run_all(todo: list[DiagnosisTask], jobs: int, path: Path) -> list[Row]:
    """Runs those that a file has no row of, and adds each row to it as it is finished."""
    rows = read_rows(path) if path.exists() else []
    done = {(row.seed, row.variant) for row in rows}
    todo = [task for task in todo if (task.seed, task.variant) not in done]
    path.parent.mkdir(exist_ok=True)
    with path.open("a", encoding="utf-8") as file:

        def keep(row: Row) -> None:
            rows.append(row)
            file.write(json.dumps(row.as_json()) + "\n")
            file.flush()
            sign = "." if row.right or not row.truth else "!"
            print(sign, end="" if len(rows) % 80 else "\n", file=sys.stderr, flush=True)

        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, mp_context=spawn) as pool:
            for finished in as_completed([pool.submit(diagnose, task) for task in todo]):
                keep(finished.result())
    print(f"\n{len(rows)} cases; rows in {path}", file=sys.stderr)
    return rows


def targets(figures: dict[str, float]) -> dict[str, Target]:
    """Targets, of the figures that were measured."""
    return {
        name: judge(figures[name], limit)
        for name, (limit, judge) in LIMITS.items()
        if name in figures
    }


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick=f"{QUICK_CASES} cases")
    parser.add_argument("--cases", type=int, default=1000, help="number of cases")
    parser.add_argument("--seed0", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--into", type=Path, help="continue this file of rows")
    parser.add_argument("--rows", type=Path, help="print the tables of this file; run nothing")
    options = parser.parse_args()
    if options.rows:
        rows = read_rows(options.rows)
    else:
        todo = tasks(options.cases, options.seed0)[: QUICK_CASES if options.quick else None]
        path = options.into or OUT / "hidden_effects.jsonl"
        if options.into is None:
            path.unlink(missing_ok=True)
        rows = run_all(todo, options.jobs, path)
    figures: dict[str, Any] = summary(rows)
    if not options.json:
        show(rows)
        print()
        for name, value in figures.items():
            print(f"  {name:30s} {value if isinstance(value, str) else f'{value:.4g}'}")
    counted = figures | {"confusion": confusion(rows), "confidence": confidence(rows)}
    return print_results(counted, targets(figures), as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
