"""How soon does an emergency stop reach a rig on a machine with more work than cores?

Command: `python -m experiments.emergency_stop`.
Target: 10 ms to the rig where both processes run in real time.

Stops are sent to a served rig from another process, without other work and with many busy
processes. Two times are counted from the call: until the rig's own `estop` is called, and until
the reply. Three schedules: both processes ordinary, the rig's server in real time, and both.
"""

import argparse
import logging
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from estune.hardware.real_time import request_priority
from estune.remote import zenoh
from estune.support.child_process import child_process, next_line
from experiments.busy import busy
from experiments.inert_rig import DESCRIBED, RECORD, InertRig
from experiments.results import at_most, command_line, print_results

BUSY = 16
LIMIT_ms = 10.0
SCHEDULES = {"ordinary": (0, 0), "server": (20, 0), "both": (20, 20)}
"""Real-time priority of the server and of the client."""
GAP_s = 0.02


class StampedRig(InertRig):
    """A rig that prints when it is stopped."""

    def estop(self, reason: str) -> None:
        """Prints the time and the reason."""
        now = time.monotonic()
        super().estop(reason)
        print(now, reason, flush=True)


class Times(NamedTuple):
    """Durations of the stops under one schedule, ms."""

    reached_ms: list[float]
    answered_ms: list[float]


def serve(priority: int) -> None:
    """Serves a rig until standard input is closed."""
    logging.disable(logging.WARNING)  # every stop is logged
    note = request_priority(priority)
    with (
        tempfile.TemporaryDirectory() as folder,
        zenoh.serve(
            StampedRig(DESCRIBED, RECORD), "tcp/127.0.0.1:0", ledger=Path(folder) / "ledger"
        ) as server,
    ):
        print(server.endpoint, note, flush=True)
        sys.stdin.read()


def stop(endpoint: str, priority: int, turns: int) -> None:
    """Stops the rig so many times, and prints when each call began and ended."""
    request_priority(priority)
    with zenoh.connect(endpoint) as rig:
        rig.estop("first")  # it opens a connection
        print("ready", flush=True)
        sys.stdin.readline()
        for turn in range(turns):
            time.sleep(GAP_s)
            began = time.monotonic()
            rig.estop(str(turn))
            print(began, time.monotonic(), flush=True)


def measure(schedule: str, processes: int, turns: int) -> Times:
    """Stops under a schedule, beside so many busy processes."""
    server_priority, client_priority = map(str, SCHEDULES[schedule])
    this = "experiments.emergency_stop"
    with child_process(this, "--serve", server_priority) as server:
        endpoint, *_ = next_line(server).split()
        with child_process(this, "--stop", endpoint, client_priority, str(turns)) as client:
            next_line(client)
            with busy(processes):  # only now, for programs start slowly on a busy machine
                print(file=client.stdin, flush=True)
                lines = [tuple(map(float, next_line(client).split())) for _ in range(turns)]
        reached: dict[str, float] = {}
        while str(turns - 1) not in reached:  # a stop that is slow to be answered is repeated
            stamp, reason = next_line(server).split()
            reached.setdefault(reason, float(stamp))
    stamps = [reached[str(turn)] for turn in range(turns)]
    return Times(
        [1e3 * (at - began) for at, (began, _) in zip(stamps, lines, strict=True)],
        [1e3 * (ended - began) for began, ended in lines],
    )


def main() -> int:
    """Measures and prints; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="a few stops only")
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--stop", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        serve(arguments.serve)
        return 0
    if arguments.stop:
        endpoint, priority, turns = arguments.stop
        stop(endpoint, int(priority), int(turns))
        return 0
    turns, processes = (5, 2) if arguments.quick else (200, BUSY)
    figures: dict[str, float | int | str] = {"turns": turns, "cores": os.cpu_count() or 0}
    for load, busy_ones in (("idle", 0), ("loaded", processes)):
        for schedule in ("both",) if arguments.quick else SCHEDULES:
            times = measure(schedule, busy_ones, turns)
            for what, values in times._asdict().items():
                name = f"{load}_{schedule}_{what.removesuffix('_ms')}"
                figures[f"{name}_median_ms"] = statistics.median(values)
                figures[f"{name}_p99_ms"] = statistics.quantiles(values, n=100)[-1]
    targets = {
        name: at_most(float(figures[name]), LIMIT_ms)
        for name in ("loaded_both_reached_p99_ms", "loaded_both_answered_p99_ms")
    }
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
