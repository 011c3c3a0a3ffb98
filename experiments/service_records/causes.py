"""Is the cause of a restless loop told: its tuning, its actuator, its sensor, or the outside?

Command: `python -m experiments.service_records.causes`.
Target: of loops whose cause is told 90 % rightly, 70 % told, at most 1 % of the others called
sticking.

Loops of first to third order, a third of them integrating, under P, PI or PID with noise of 0.1 to
2 %, each with one fault that raises the error by half at least, or none (`loops`). The judge knows
setpoint, measurement and output. With --unlike the loops, which stick or are sound, are those of
`unlike_loops`.
"""

import sys
import time
from typing import Any

from estune.service_records.cause.judge import judge_signals
from estune.service_records.cause.loop_signals import JudgedSignals
from experiments.results import at_least, at_most, command_line, print_results
from experiments.service_records import loops, unlike_loops
from experiments.service_records.loops import DrawnLog


def judged(log: DrawnLog, seed: int, cause: str) -> tuple[str, float]:
    """What a loop of known cause is judged to have, and the CPU time."""
    begun = time.process_time()
    found = judge_signals(JudgedSignals(log.setpoint, log.measurement, log.output, 1.0))
    print(seed, cause, log.detail, found.name, f"{found.probability:.2f}", file=sys.stderr)
    return found.name, time.process_time() - begun


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="four loops of each cause")
    parser.add_argument("--loops", type=int, default=40, help="loops of each cause")
    parser.add_argument("--seed0", type=int, default=1, help="first seed: see seeds.md")
    parser.add_argument("--unlike", action="store_true", help="loops unlike those of the weights")
    options = parser.parse_args()
    kind = unlike_loops if options.unlike else loops
    seeds = range(options.seed0, options.seed0 + (4 if options.quick else options.loops))
    rows, told, right, false, others, count = list[dict[str, Any]](), 0, 0, 0, 0, 0
    for cause in kind.CAUSES:
        names = [judged(kind.draw(seed, cause), seed, cause) for seed in seeds]
        found = [name for name, _ in names]
        row = {name: found.count(name) for name in (*loops.CAUSES, "unknown")}
        rows.append({"cause": cause, **row, "cpu_s": max(cpu for _, cpu in names)})
        count += len(found)
        told += len(found) - row["unknown"]
        right += row[cause]
        if cause != "sticking":
            others, false = others + len(found), false + row["sticking"]
    targets = {
        "right_of_told": at_least(right / told if told else None, 0.9),
        "told": at_least(told / count, 0.7),
        "false_sticking": at_most(false / others, 0.01),
    }
    return print_results({"rows": rows}, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
