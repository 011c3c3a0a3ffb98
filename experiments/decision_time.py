"""Where does the CPU time of a decision go, and that of judging logs?

Command: `python -m experiments.decision_time`.
Target: a decision 30 ms at the median over the plants of `experiments.batch` and runs of the
reference reel, a log 1.5 s, a folder of ten logs 6 s.

A decision is what follows a trial of the search: the fit, the optimum, its half widths, the draws
of how much is left to gain and the next excitation. Each part is timed by itself, as it is called.
The logs are those of `experiments.loop_costs`, or with `--logs PATH ...` measured ones.
"""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import estune
from estune.loop_model.optimum import RegionSearch
from estune.run import loop, session
from estune.run.phase import Phase
from estune.service_records.suggestion import GainsUnknown, suggest
from estune.support.blas import one_blas_thread
from estune.tuners import identified_loop, model_convergence
from experiments.batch.__main__ import start_of
from experiments.batch.loop import ProcessLoop
from experiments.batch.processes import PROCESSES
from experiments.batch.rig import BatchRig
from experiments.loop_costs import cases, judging_s, service_logs
from experiments.results import Target, at_most, command_line, print_results
from plants.simulation.simulated_rig import SimulatedRig

ALL = "all"
PARTS: tuple[tuple[str, Any, str], ...] = (
    (ALL, loop, "after_trial"),
    (ALL, loop, "with_excitation"),
    ("fit", identified_loop, "fit_loop"),
    ("fit", identified_loop, "fit_with_excitations"),
    ("optimum", RegionSearch, "minimise"),
    ("half widths", identified_loop, "half_widths"),
    ("draws", model_convergence, "draw_optima"),
    ("excitation", session, "excitation_trial"),
)
"""Functions that are timed, by where they are called; what is called within another is its own."""

Times = dict[str, float]


def decisions(rig: Any, cost: Any) -> list[Times]:
    """CPU time of each decision of a tuning by its parts, s."""
    found, phases, inside = list[Times](), list[Phase](), list[str]()

    def timed(part: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            if original is session.after_trial:
                phases.append(args[0].phase)
                found.append({})
            if inside or not found:  # a part of a part, or what is before the first trial
                return original(*args, **options)
            inside.extend([part] * (part != ALL))
            began_s = time.process_time()
            try:
                return original(*args, **options)
            finally:
                found[-1][part] = found[-1].get(part, 0.0) + time.process_time() - began_s
                inside.clear()

        return call

    with ExitStack() as stack:
        for part, owner, name in PARTS:
            stack.enter_context(patch.object(owner, name, timed(part, getattr(owner, name))))
        estune.tune(rig, cost=cost, journal=False, watch=None)
    return [one for one, phase in zip(found, phases, strict=True) if phase != Phase.CONFIRM]


def table(taken: list[Times]) -> dict[str, dict[str, float]]:
    """Median, mean and largest time of each part, ms."""
    names = dict.fromkeys(part for part, *_ in PARTS)
    rows = {name: 1e3 * np.array([one.get(name, 0.0) for one in taken]) for name in names}
    rows["rest"] = 2.0 * rows[ALL] - sum(rows.values())
    return {
        name: {"median_ms": float(np.median(x)), "mean_ms": float(x.mean()), "max_ms": x.max()}
        for name, x in rows.items()
    }


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="three plants and one run of the reel")
    parser.add_argument("--logs", type=Path, nargs="*", help="logs and folders to judge")
    options = parser.parse_args()
    processes, seeds = (PROCESSES[:3], [0]) if options.quick else (PROCESSES, [0, 1, 2])
    reel, taken = next(cases()), list[list[Times]]()
    for process in (processes[0], *processes):
        taken.append(
            decisions(BatchRig(ProcessLoop(process, 0.003), start_of(process), 0), "paper")
        )
    for seed in seeds:
        simulated = SimulatedRig(reel.plant, seed=seed, gains=reel.start)
        taken.append(decisions(simulated, reel.cost))
        simulated.close()
    # The first run loads what is loaded once.
    figures: dict[str, Any] = {"decisions": table([*chain(*taken[1:])])}
    median_ms = figures["decisions"][ALL]["median_ms"]
    targets: dict[str, Target] = {"decision_median_ms": at_most(median_ms, 30.0)}
    logs = {"log": (1, 10_000), "folder_of_ten": (10, 1_000)}
    for name, (count, samples) in {} if options.logs else logs.items():
        records = service_logs(reel.plant, samples, count)
        targets[f"{name}_s"] = at_most(judging_s(records), 6.0 if count > 1 else 1.5)
    for path in options.logs or ():
        began_s = time.process_time()
        try:
            suggest(path)
        except GainsUnknown as error:
            print(f"{path}: {error}", file=sys.stderr)
        spent_s = time.process_time() - began_s
        targets[f"{path.name}_s"] = at_most(spent_s, 6.0 if path.is_dir() else 1.5)
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    with one_blas_thread():  # as runs of the product do
        raise SystemExit(main())
