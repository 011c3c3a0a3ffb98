"""Accuracy and speed of the solution of a hanging cable from any three of its quantities.

Random cables over six decades of tension and weight, from nearly taut to very slack, with either
end higher. Each of the 52 admissible triples is solved, for both cables where two fit. Printed are
the worst relative residual of (3) to (6) and the time.
"""

import statistics
import sys
import time
from typing import Any

import numpy as np

from experiments.results import Target, command_line, print_results
from plants import cable

LIMITS = {"worst_residual": 1e-9, "worst_s_per_million": 1.0}


def random_cables(count: int) -> cable.Catenary:
    """Random cables by tension, weight, slope at the middle and span over sag."""
    random = np.random.default_rng(3)
    tension_x_N = np.exp(random.uniform(-3.0, 3.0, count))
    weight_N_m = np.exp(random.uniform(-5.0, 2.0, count))
    middle = random.uniform(-3.0, 3.0, count)
    half = np.exp(random.uniform(np.log(1e-3), np.log(3.0), count))
    # A cable along x is the catenary's piece about `middle`, of half-width `half`, in units T_x/w.
    scale = tension_x_N / weight_N_m
    return cable.catenary(
        weight_N_m,
        span_m=2.0 * half * scale,
        rise_m=2.0 * np.sinh(middle) * np.sinh(half) * scale,
        length_m=2.0 * np.cosh(middle) * np.sinh(half) * scale,
    )


def measure(count: int) -> dict[str, dict[str, float]]:
    """Residual and time for each triple and solution."""
    truth, rows = random_cables(count), {}
    for triple, solutions in cable.ADMISSIBLE.items():
        known = {name: getattr(truth, name) for name in cable.NAMES if name in triple}
        for solution in solutions:
            began = time.process_time()
            solved = cable.catenary(truth.weight_N_m, solution=solution, **known)
            took = time.process_time() - began
            rows[f"{', '.join(known)}; {solution}"] = {
                "residual": float(np.max(solved.residual())),
                "s_per_million": took * 1e6 / count,
            }
    return rows


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    options = command_line(__doc__, quick="fewer cables").parse_args()
    count = 50_000 if options.quick else 1_000_000
    rows = measure(count)
    per_million = [row["s_per_million"] for row in rows.values()]
    figures: dict[str, Any] = {
        "cables": count,
        "worst_residual": max(row["residual"] for row in rows.values()),
        "median_s_per_million": statistics.median(per_million),
        "worst_s_per_million": max(per_million),
        "triples": rows,
    }
    targets = {
        name: Target(figures[name], limit, figures[name] < limit) for name, limit in LIMITS.items()
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
