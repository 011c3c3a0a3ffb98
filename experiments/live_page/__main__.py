"""Does the live page show a trial at once, and cost the run or the rig nothing?

Command: `python -m experiments.live_page`.
Target: update in 0.5 s, usable in 1 s, no fault of access, 98 % of the rate of trials, stops in 5
ms, a dragged slider drawn in 50 ms.

Every part is a process of its own: a tuning, a daemon, a rig, the page's server. Ten pages are
this process, which reads their event streams; one is a headless Chromium.

* Page, usable: size of all files, and time from the request to state and charts, in Chromium.
* Update: time from the commit of a trial, by the journal, until Chromium shows it.
* Stale: time from the end of the rig's process until Chromium shows that there is no link.
* Faults: serious ones that axe-core finds at 400 and 1280 px, light and dark, messages of the
  browser's console, and requests to other hosts.
* Redraw: time from a move of the mouse that drags a slider of the tuning page until the page has
  painted what follows from it, as the page itself measures it; sliders of a wide and a narrow one.
* History: time until a page of a run with 100 000 trials has been sent them.
* Table: time from the request until Chromium shows the table of a folder of 1000 runs, where the
  server has just started and again; and the rate of trials of a tuning in that folder, with ten
  pages of its run and its list open, which a process of its own reads, and without, in turns.
* Rate: a daemon's trials in equal times, with ten pages open and without, in turns. Without pages
  a daemon reads nothing for them, `LINGER_S` after the last was closed.
* Stop: 99th centile of the time until a rig has answered an emergency stop, likewise.
"""

import json
import sqlite3
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import plants
from estune import tune
from estune.remote import zenoh
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.web.reader import LINGER_S
from experiments.live_page.browser import SeenPage, look_at
from experiments.live_page.commands import command, printed, stream
from experiments.live_page.drag import redraws_ms
from experiments.live_page.many_runs import PAGES, RUNS, measure
from experiments.results import Target, at_least, at_most, command_line, print_results

TRIALS_LONG = 100_000
DAEMON = """
[service]
listen = "tcp/127.0.0.1:0"
[page]
http_port = 0
[[rig]]
name = "reel"
target = "{endpoint}"
[rig.tuning]
tuner = "least_squares_gradient"
trials = 1000000
tolerance = 0.0
"""


def changes(address: str, view: str) -> Iterator[dict[str, Any]]:
    """Data that a page is sent."""
    event = b"message"
    for line in stream(address, view):
        if line.startswith(b"event: "):
            event = line[7:].strip()
        elif line.startswith(b"data: "):
            if event == b"message":
                yield json.loads(line[6:])
            event = b"message"


@contextmanager
def pages_open(address: str, view: str) -> Iterator[None]:
    """Ten pages that read all they are sent."""
    ended = threading.Event()

    def read() -> None:
        for _ in stream(address, view):
            if ended.is_set():
                return

    threads = [threading.Thread(target=read, daemon=True) for _ in range(PAGES)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()


def in_browser(folder: Path, watch_s: float) -> tuple[SeenPage, list[float]]:
    """Observations of a tuning's page, and times from each trial's commit to its display."""
    options = ("--trials", 10_000, "--tolerance", 0, "--tuner", "least_squares_gradient")
    with ExitStack() as stack:
        rig = stack.enter_context(command("serve", "--pace", 0.2, "--ledger", "memory"))
        endpoint = printed(rig, "rig reel at ")
        run = ("tune", endpoint, *options, "--quiet", "--run", "live", "--folder", folder)
        stack.enter_context(command(*run))
        while not (folder / "live" / "run.sqlite-wal").exists():
            time.sleep(0.1)
        time.sleep(2.0)
        watch = stack.enter_context(command("watch", folder / "live", "--port", 0))
        seen = look_at(printed(watch, "page at "), watch_s, rig.kill)
    with sqlite3.connect(folder / "live" / "run.sqlite") as journal:
        told = journal.execute("SELECT told_at FROM trial WHERE told_at NOT NULL ORDER BY told_at")
        committed_s = [datetime.fromisoformat(at).astimezone(UTC).timestamp() for (at,) in told]
    return seen, [at_s - committed_s[n - 1] for n, at_s in seen.shown_at_s.items()]


def history_s(folder: Path, trials: int) -> float:
    """Time until a page has been sent the trials of a long run."""
    tune(plants.reference_reel(), trials=3, run="long", folder=folder, watch=None)
    with sqlite3.connect(folder / "long" / "run.sqlite") as journal:
        costs = 1.0 + np.random.default_rng(0).lognormal(size=trials)
        journal.executemany(
            "INSERT INTO trial (number, attempt, trial_id, phase, P, I, D, setpoint_filter_s,"
            " asked_at, outcome, cost, margin) VALUES (?, 0, ?, 'search', 1, 1, 1, 1, '', 'done',"
            " ?, 1)",
            ((100 + n, f"more-{n}", cost) for n, cost in enumerate(costs.tolist())),
        )
    with command("watch", folder / "long", "--port", 0) as watch:
        address = printed(watch, "page at ")
        begun_s = time.perf_counter()
        next(change for change in changes(address, "long") if change["tables"].get("trials"))
        return time.perf_counter() - begun_s


def rates(folder: Path, rounds: int, each_s: float) -> tuple[list[float], list[float]]:
    """A daemon's trials a second without and with pages open, in turns."""
    without, having = [], []
    with ExitStack() as stack:
        rig = stack.enter_context(command("serve", "--ledger", "memory"))
        file = folder / "daemon.toml"
        file.write_text(DAEMON.format(endpoint=printed(rig, "rig reel at ")), encoding="utf-8")
        daemon = stack.enter_context(command("daemon", file))
        endpoint, address = printed(daemon, "daemon at "), printed(daemon, "page at ")
        client = stack.enter_context(DaemonClient(endpoint))

        def rate() -> float:
            first, begun_s = client.status("reel").trials, time.perf_counter()
            time.sleep(each_s)
            done = client.status("reel").trials - first
            return done / (time.perf_counter() - begun_s)

        while client.status("reel").trials < 5:
            time.sleep(0.1)
        for _ in range(rounds):
            without.append(rate())
            with pages_open(address, "reel"):
                time.sleep(0.5)
                having.append(rate())
            time.sleep(LINGER_S)
    return without, having


def stops_ms(rounds: int, each: int) -> tuple[list[float], list[float]]:
    """Times until a rig has answered an emergency stop, without and with pages open, in turns."""
    without: list[float] = []
    having: list[float] = []
    with ExitStack() as stack:
        server = stack.enter_context(command("serve", "--ledger", "memory"))
        endpoint = printed(server, "rig reel at ")
        watch = stack.enter_context(command("watch", endpoint, "--port", 0))
        address = printed(watch, "page at ")
        rig = stack.enter_context(zenoh.connect(endpoint))

        def stop() -> float:
            begun_s = time.perf_counter()
            rig.estop("experiment")
            taken_s = time.perf_counter() - begun_s
            rig.clear()
            return 1e3 * taken_s

        for _ in range(rounds):
            without += [stop() for _ in range(each)]
            with pages_open(address, "reel"):
                time.sleep(0.5)
                having += [stop() for _ in range(each)]
    return without, having


def main() -> int:
    """Measures, and prints the figures."""
    options = command_line(__doc__, quick="fewer trials and turns").parse_args()
    quick = options.quick
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seen, updates = in_browser(folder, 5.0 if quick else 40.0)
        dragged_ms = redraws_ms(folder, 20 if quick else 100)
        opened_s = history_s(folder, 2000 if quick else TRIALS_LONG)
        many = measure(folder / "many", 50 if quick else RUNS, *((1, 2.0) if quick else (8, 8.0)))
        without, having = rates(folder, 1 if quick else 8, 2.0 if quick else 8.0)
        plain_ms, watched_ms = stops_ms(1 if quick else 5, 20 if quick else 200)
    many_ratio = statistics.fmean(many.having) / statistics.fmean(many.without)
    ratio = statistics.fmean(having) / statistics.fmean(without)
    p99 = [float(np.quantile(times, 0.99)) for times in (plain_ms, watched_ms)]
    faults = [*seen.faults, *seen.complaints, *seen.elsewhere]
    figures: dict[str, Any] = {
        "page_kB": seen.page_kB,
        "usable_s": seen.usable_s,
        "stale_s": seen.stale_s,
        "faults": len(faults),
        "faults_found": faults,
        "update_median_s": statistics.median(updates),
        "update_max_s": max(updates),
        "redraw_median_ms": {str(w): statistics.median(ms) for w, ms in dragged_ms.items()},
        "redraw_p90_ms": {str(w): float(np.quantile(ms, 0.9)) for w, ms in dragged_ms.items()},
        "history_s": opened_s,
        "table_first_s": many.first_s,
        "table_again_s": many.again_s,
        "tuning_trials_per_s": statistics.fmean(many.without),
        "tuning_trials_per_s_with_pages": statistics.fmean(many.having),
        "trials_per_s": statistics.fmean(without),
        "trials_per_s_with_pages": statistics.fmean(having),
        "stop_p99_ms": p99[0],
        "stop_p99_with_pages_ms": p99[1],
    }
    targets: dict[str, Target] = {
        "page_kB": at_most(seen.page_kB, 150.0),
        "usable_s": at_most(seen.usable_s, 1.0),
        "stale_s": at_most(seen.stale_s, 2.0),
        "faults": at_most(len(faults), 0),
        "update_max_s": at_most(max(updates), 0.5),
        "redraw_median_ms": at_most(max(map(statistics.median, dragged_ms.values())), 50.0),
        "history_s": at_most(opened_s, 2.0),
        "table_again_s": at_most(many.again_s, 1.0),
        "tuning_rate_share": at_least(many_ratio, 0.98),
        "rate_share": at_least(ratio, 0.98),
        "stop_p99_with_pages_ms": at_most(p99[1], 5.0),
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
