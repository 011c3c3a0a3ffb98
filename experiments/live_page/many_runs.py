"""A folder of a thousand runs on ten pages: time until its table is open, and the rate of trials.

The pages are clients of HTTP in a process of their own, which ask for all that a browser's page
asks for, at its times: ten browsers take more than a machine of two cores has.
"""

import http.client
import shutil
import sqlite3
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import plants
from estune import tune
from estune.support.child_process import child_process
from estune.web.reader import LINGER_S
from experiments.live_page.browser import new_page
from experiments.live_page.commands import WITHIN_S, command, printed, stream

RUNS = 1000
PAGES = 10
LIST_EVERY_S = 3.0
"""Interval at which a page asks for the list (`setInterval(list, 3000)` in page.js)."""
RUN = "live"


class ManyRuns(NamedTuple):
    """Observations of a folder of many runs.

    Attributes:
        first_s: Time from the request of the page to its table where the server has just started.
        again_s: The same once the server has read the runs.
        without: Trials a second of a tuning in the folder, in turns without pages.
        having: The same with ten pages open.
    """

    first_s: float
    again_s: float
    without: list[float]
    having: list[float]


def measure(folder: Path, runs: int, rounds: int, each_s: float) -> ManyRuns:
    """Fills a folder with copies of a run, opens it, and tunes in it with and without pages."""
    tune(plants.reference_reel(), trials=3, repeats=2, run="run-0", folder=folder, watch=None)
    for n in range(1, runs):
        shutil.copytree(folder / "run-0", folder / f"run-{n}")
    with ExitStack() as stack:
        watch = stack.enter_context(command("watch", folder, "--port", 0))
        address = printed(watch, "page at ")
        first_s, again_s = _opened_s(address), _opened_s(address)
        rig = stack.enter_context(command("serve", "--ledger", "memory"))
        options = ("--trials", 1_000_000, "--tolerance", 0, "--tuner", "least_squares_gradient")
        run = ("--run", RUN, "--folder", folder, "--quiet")
        stack.enter_context(command("tune", printed(rig, "rig reel at "), *options, *run))
        journal = folder / RUN / "run.sqlite"
        while not journal.with_name(f"{journal.name}-wal").exists() or _trials(journal) < 5:
            time.sleep(0.1)
        without, having = [], []
        for _ in range(rounds):
            time.sleep(LINGER_S + 1.0)  # nothing is read for pages any more
            without.append(_rate(journal, each_s))
            with child_process(__name__, address) as pages:
                printed(pages, "open")
                having.append(_rate(journal, each_s))
    return ManyRuns(first_s, again_s, without, having)


def _opened_s(address: str) -> float:
    """Time from the request of the page to its table, in a new browser."""
    with new_page() as page:
        begun_s = time.perf_counter()
        page.goto(address)
        page.wait_for_function("() => document.querySelector('#views tbody').rows.length > 1")
        return time.perf_counter() - begun_s


def _trials(journal: Path) -> int:
    with sqlite3.connect(journal) as file:
        (count,) = file.execute("SELECT count(told_at) FROM trial").fetchone()
        return int(count)


def _rate(journal: Path, each_s: float) -> float:
    first, begun_s = _trials(journal), time.perf_counter()
    time.sleep(each_s)
    return (_trials(journal) - first) / (time.perf_counter() - begun_s)


def _page(address: str, opened: threading.Semaphore) -> None:
    """Reads the events of the tuning, and asks for the list as often as a page does."""
    events = stream(address, RUN)
    threading.Thread(target=lambda: [None for _ in events], daemon=True).start()
    link, tag = http.client.HTTPConnection(address.split("/")[2], timeout=WITHIN_S), ""
    while True:
        link.request("GET", "/api/views", headers={"If-None-Match": tag})
        answer = link.getresponse()
        answer.read()
        tag = answer.getheader("ETag", "")
        opened.release()
        time.sleep(LIST_EVERY_S)


def main() -> None:
    """Opens the pages until it is killed."""
    opened = threading.Semaphore(0)
    for _ in range(PAGES):
        threading.Thread(target=_page, args=(sys.argv[1], opened), daemon=True).start()
    for _ in range(PAGES):
        opened.acquire()
    print("open", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
