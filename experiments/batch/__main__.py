"""How near to the best possible does estune tune the usual test plants, beside the usual rules?

Command: `python -m experiments.batch`.
Target: plainly TUNED, within 1 % of the optimum in at most 12 trials and 10 CPU s on every plant
of the batch; no plain TUNED above a limit by more than 1 % of it; the median of trials at most 8.

The batch is that of Astrom and Hagglund, with six plants beside it that are unstable in open loop.
Each is tuned from poor stable gains by trials with noise, and compared with the direct search of
the optimum of the same cost within the same limits (Ms 1.6, overshoot 5 %), and with rules. All is
judged by a simulation of this experiment alone.

What favours whom. The rules know the process exactly and without noise; estune sees noisy trials
alone. The cost and the limits are those that estune optimises, and no rule aims at: a rule with
less load IAE and a larger Ms answers another question. Every rule gets the setpoint filter of
least cost, and the filter on the derivative of estune's loop in place of its author's.
"""

import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import estune
from estune.core.cost import PRESETS, StepCost
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.support.blas import one_blas_thread
from experiments.batch.figure import draw
from experiments.batch.finished import Finished
from experiments.batch.loop import LoopFigures, ProcessLoop
from experiments.batch.optimum import MAX_OVERSHOOT, MAX_SENSITIVITY, optimum, with_best_filter
from experiments.batch.processes import PROCESSES, UNSTABLE, Process
from experiments.batch.rig import BatchRig, Disturbance
from experiments.batch.rules import RULES
from experiments.results import Target, at_least, at_most, command_line, print_results

QUICK = ("e^-s/(2s+1)", "1/(s+1)^3")
SLOW_FILTER = 0.5
"""Setpoint filter, in settling times, of one more start of the optimum: a loop may have one valley
with a slow filter and another one with a fast."""

NEAR, TRIALS, CPU_S, BEYOND = 0.01, 12, 10.0, 0.01

Row = dict[str, Any]


def start_of(process: Process) -> Gains:
    """The initial gains: a seventh of the ultimate gain, with slow integral action."""
    if process.start is not None:
        return process.start
    K, period_s = process.ultimate
    Ti = period_s * (4.0 if process.integrators else 1.0)
    return Gains.from_standard(0.15 * K, Ti, 0.05 * period_s, 0.1 * period_s)


def tuned(
    loop: ProcessLoop, seed: int, cost: str, disturbance: Disturbance
) -> tuple[Row, Gains, StepCost | None]:
    """What a run says, its gains, and its cost; None where the run was refused."""
    start = start_of(loop.process)
    rig, began_s = BatchRig(loop, start, seed, disturbance), time.process_time()
    try:
        result = estune.tune(rig, cost=cost, journal=False, watch=None)
    except EstuneError as error:
        return {"trials": rig.trials, "ending": f"refused: {error}"}, start, None
    cpu_s = time.process_time() - began_s
    margins, change = result.claim.margins, result.improvement if result.success else None
    row = {
        "trials": rig.trials,
        "cpu_s": cpu_s,
        "ending": str(result.ending),
        "why": result.limits.reason if result.limits else result.message,
        "claimed_Ms": list(margins.sensitivity) if margins else None,
        "claimed_overshoot": list(margins.overshoot) if margins else None,
        "claimed_change": [change.estimate, change.low, change.high] if change else None,
        "gains": list(result.gains.as_tuple()),
    }
    return row, result.gains, result.plan.cost


def figures_of(at: LoopFigures, best: float) -> Row:
    """Figures of some gains, in the units of the table."""
    return {
        "above_percent": 100.0 * (at.cost / best - 1.0),
        "Ms": at.Ms,
        "overshoot_percent": 100.0 * at.overshoot,
        "load_IAE_s": at.load_IAE,
    }


class Conditions(NamedTuple):
    """What is the same for all processes.

    Attributes:
        noise: Standard deviation of the noise as a share of the step.
        seeds: Of the trials' noise.
        cost: Name of the cost.
        disturbance: What acts on the loop in estune's trials alone.
    """

    noise: float
    seeds: Sequence[int]
    cost: str
    disturbance: Disturbance


def measure(process: Process, at: Conditions) -> Row:
    """The row of a process: the rules, and each seed of estune's."""
    loop = ProcessLoop(process, at.noise)
    runs = [tuned(loop, seed, at.cost, at.disturbance) for seed in at.seeds]
    scored = next((of for *_, of in runs if of is not None), None)
    row: Row = {"plant": process.name, "family": process.family}
    if scored is None:
        return row | {"estune": [run for run, *_ in runs], "rules": {}}
    rules = {} if process.family == UNSTABLE else {n: rule(loop) for n, rule in RULES.items()}
    filtered = {n: with_best_filter(loop, scored, gains) for n, gains in rules.items() if gains}
    tried = [list(filtered.values()), [gains for _, gains, _ in runs]]
    nearest = [min(some, key=lambda g: loop.judged(g, scored)[0]) for some in tried if some]
    poor = start_of(process)
    slow = replace(poor, setpoint_filter_s=SLOW_FILTER * process.settling_time_s)
    best = optimum(loop, scored, [poor, slow, *nearest])
    least = loop.at(best, scored)
    row["optimum"] = figures_of(least, least.cost) | {"gains": list(best.as_tuple())}
    row["rules"] = {n: figures_of(loop.at(g, scored), least.cost) for n, g in filtered.items()}
    row["estune"] = [
        run if of is None else run | figures_of(loop.at(gains, scored), least.cost)
        for run, gains, of in runs
    ]
    return row


def is_beyond(run: Row) -> bool:
    """Whether a plain TUNED is truly above a limit by more than `BEYOND` of it."""
    if run["ending"] != "tuned":
        return False
    overshoot = 100.0 * MAX_OVERSHOOT
    most = (1.0 + BEYOND) * np.array([MAX_SENSITIVITY, overshoot])
    return bool(np.any(np.array([run["Ms"], run["overshoot_percent"]]) > most))


def is_inside(run: Row) -> bool:
    """Whether the claimed interval of Ms contains the true one."""
    low, high = run["claimed_Ms"][1:]
    return bool(low <= run["Ms"] <= high)


def targets_of(rows: Iterable[Row]) -> dict[str, Target]:
    """The targets, each of all runs."""
    runs = [run for row in rows for run in row["estune"]]
    known = [run for run in runs if "Ms" in run]
    claimed = [run for run in known if run["claimed_Ms"]]
    near = [run.get("above_percent", math.inf) <= 100.0 * NEAR for run in runs]
    return {
        "near": at_least(float(np.mean(near)), 1.0),
        "plainly_tuned": at_least(float(np.mean([r["ending"] == "tuned" for r in runs])), 1.0),
        "beyond_a_limit": at_most(sum(map(is_beyond, known)), 0),
        "claims_inside": at_least(float(np.mean([*map(is_inside, claimed)])), 0.95)
        if claimed
        else at_least(None, 0.95),
        "median_trials": at_most(float(np.median([run["trials"] for run in runs])), 8.0),
        "most_trials": at_most(max(run["trials"] for run in runs), TRIALS),
        "most_cpu_s": at_most(max(run.get("cpu_s", math.inf) for run in runs), CPU_S),
    }


def table_of(rows: Sequence[Row]) -> dict[str, Row]:
    """A line for each plant: estune's medians, and "above / Ms" of each rule."""
    table = {}
    for row in rows:
        runs = [run for run in row["estune"] if "Ms" in run]
        line: Row = {"tuned": f"{sum(r['ending'] == 'tuned' for r in runs)}/{len(row['estune'])}"}
        for key in ("trials", "cpu_s", "above_percent", "Ms", "overshoot_percent", "load_IAE_s"):
            line[key] = float(np.median([run[key] for run in runs])) if runs else math.nan
        for name in RULES:
            at = row["rules"].get(name)
            line[name] = _cell(at) if at else "-"
        table[row["plant"]] = line
    return table


def _cell(at: Row) -> str:
    if not math.isfinite(at["Ms"]):
        return "unstable"
    return f"{at['above_percent']:.0f} / {at['Ms']:.2f} / {at['load_IAE_s']:.2g}"


def summary_of(rows: Sequence[Row]) -> dict[str, Row]:
    """By rule, over the batch without the plants that no rule is made for."""
    rows = [row for row in rows if row["family"] != UNSTABLE and "optimum" in row]
    found = {"estune": [run for row in rows for run in row["estune"] if "Ms" in run]}
    found |= {n: [row["rules"][n] for row in rows if n in row["rules"]] for n in RULES}
    return {name: _summary(of) for name, of in found.items() if of}


def _summary(found: Sequence[Row]) -> Row:
    stable = [one for one in found if math.isfinite(one["Ms"])]
    above, Ms = ([one[key] for one in stable] for key in ("above_percent", "Ms"))
    return {
        "unstable": len(found) - len(stable),
        "above_median": float(np.median(above)),
        "above_worst": max(above),
        "Ms_median": float(np.median(Ms)),
        "Ms_worst": max(Ms),
        "over_1.6": sum(at > (1.0 + BEYOND) * MAX_SENSITIVITY for at in Ms),
        "load_IAE_s_median": float(np.median([one["load_IAE_s"] for one in stable])),
    }


def main() -> int:
    """Prints the tables, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="two plants, one seed", out="figure and finished rows")
    parser.add_argument("--seeds", type=int, default=1, help="tunings of each plant")
    parser.add_argument("--seed0", type=int, default=0, help="first seed: see seeds.md")
    parser.add_argument(
        "--noise", type=float, nargs="+", default=[0.003], help="noises, as shares of the step"
    )
    parser.add_argument("--cost", choices=list(PRESETS), default="paper", help="cost of a trial")
    for name, about in (
        ("load", "coloured load"),
        ("load-steps", "load steps in one trial of five"),
        ("drift", "drift of the sensor over a trial"),
    ):
        parser.add_argument(f"--{name}", type=float, default=0.0, help=f"{about}, of the step")
    parser.add_argument("--plant", default="", help="only plants with this in name or family")
    options = parser.parse_args()
    quick = options.quick
    seeds = range(options.seed0, options.seed0 + (1 if quick else options.seeds))
    acting = Disturbance(options.load, options.load_steps, options.drift)
    chosen = [
        process
        for process in PROCESSES
        if (process.name in QUICK or not quick)
        and (options.plant in process.name or options.plant in process.family)
    ]
    finished = Finished(options.out / "rows.jsonl")
    by_noise: dict[str, list[Row]] = {}
    for noise in options.noise:
        at = Conditions(noise, seeds, options.cost, acting)
        rows = by_noise[f"noise {noise:g}"] = []
        for process in chosen:
            rows.append(finished.row(f"{process} {at}", partial(measure, process, at)))
            print(process.name, noise, *map(_line, rows[-1]["estune"]), sep="; ", file=sys.stderr)
    if not quick:
        draw(next(iter(by_noise.values())), options.out)
    shown = {"rows": by_noise} if options.json else {at: table_of(r) for at, r in by_noise.items()}
    figures = shown | {f"summary, {at}": summary_of(rows) for at, rows in by_noise.items()}
    targets = {
        f"{name}, {at}": target
        for at, rows in by_noise.items()
        for name, target in targets_of(rows).items()
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


def _line(run: Row) -> str:
    above = f", {run['above_percent']:.1f} % above" if "above_percent" in run else ""
    return f"{run['trials']} trials{above}, {run['ending']}"


if __name__ == "__main__":
    with one_blas_thread():  # as runs of the product do
        sys.exit(main())
